"""The script that shows a point cloud in a page: WebGL 1, no library, drag to turn, wheel to zoom, shift-drag to move."""

CLOUD_SCRIPT = r"""
for (const canvas of document.querySelectorAll("canvas.cloud")) {
  const raw = Uint8Array.from(atob(canvas.dataset.points), c => c.charCodeAt(0));
  const n = raw.length / 16, xyz = new Float32Array(raw.buffer);
  let reach = 1e-6;
  for (let i = 0; i < n; i++) reach = Math.max(reach, Math.hypot(xyz[4*i], xyz[4*i+1], xyz[4*i+2]));
  const gl = canvas.getContext("webgl", {antialias: true, preserveDrawingBuffer: true});
  if (!gl) { canvas.replaceWith("This browser has no WebGL; open cloud.ply in a viewer instead."); continue; }
  const shader = (type, text) => { const s = gl.createShader(type); gl.shaderSource(s, text); gl.compileShader(s); return s; };
  const program = gl.createProgram();
  gl.attachShader(program, shader(gl.VERTEX_SHADER,
    "attribute vec3 p; attribute vec3 c; uniform mat3 r; uniform vec4 view; uniform float size; varying vec3 colour;" +
    "void main(){ vec3 q = r * p; float d = view.w - q.z; colour = c; gl_PointSize = size;" +
    "gl_Position = vec4((q.xy + view.xy) * vec2(view.z, 1.0) * 2.4, 0.0, d) + vec4(0.0, 0.0, (d - 1.0) * 0.5, 0.0); }"));
  gl.attachShader(program, shader(gl.FRAGMENT_SHADER,
    "precision mediump float; varying vec3 colour; void main(){ gl_FragColor = vec4(colour, 1.0); }"));
  gl.linkProgram(program); gl.useProgram(program); gl.enable(gl.DEPTH_TEST);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer()); gl.bufferData(gl.ARRAY_BUFFER, raw, gl.STATIC_DRAW);
  const p = gl.getAttribLocation(program, "p"), c = gl.getAttribLocation(program, "c");
  gl.enableVertexAttribArray(p); gl.vertexAttribPointer(p, 3, gl.FLOAT, false, 16, 0);
  gl.enableVertexAttribArray(c); gl.vertexAttribPointer(c, 3, gl.UNSIGNED_BYTE, true, 16, 12);
  const at = name => gl.getUniformLocation(program, name);
  let yaw = 0.5, pitch = 2.5, distance = 2, x = 0, y = 0;
  const draw = () => {
    const ratio = window.devicePixelRatio || 1;
    canvas.width = canvas.clientWidth * ratio; canvas.height = canvas.clientHeight * ratio;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0.063, 0.082, 0.11, 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const cy = Math.cos(yaw), sy = Math.sin(yaw), cp = Math.cos(pitch), sp = Math.sin(pitch), k = 1 / reach;
    gl.uniformMatrix3fv(at("r"), false, [cy*k, sp*sy*k, -cp*sy*k, 0, cp*k, sp*k, sy*k, -sp*cy*k, cp*cy*k]);
    gl.uniform4f(at("view"), x, y, canvas.height / canvas.width, distance);
    gl.uniform1f(at("size"), Math.max(1.5, 1.6 * ratio)); gl.drawArrays(gl.POINTS, 0, n);
  };
  let last = null;
  canvas.onpointerdown = e => { last = e; canvas.setPointerCapture(e.pointerId); };
  canvas.onpointerup = () => { last = null; };
  canvas.onpointermove = e => {
    if (!last) return;
    const dx = (e.clientX - last.clientX) / canvas.clientHeight, dy = (e.clientY - last.clientY) / canvas.clientHeight;
    if (e.shiftKey) { x += dx * distance * 0.8; y -= dy * distance * 0.8; } else { yaw += 4 * dx; pitch += 4 * dy; }
    last = e; draw();
  };
  canvas.onwheel = e => { e.preventDefault(); distance = Math.min(20, Math.max(1.05, distance * Math.exp(e.deltaY * 0.001))); draw(); };
  new ResizeObserver(draw).observe(canvas); draw();
}
"""
