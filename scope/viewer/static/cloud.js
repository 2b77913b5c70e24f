// Points in chunks of a space-filling curve, each in an order of which every beginning covers the chunk evenly: as many are drawn as
// the view deserves and the machine manages (level of detail), and picking looks at all of them.

const CHUNK = 32768;

function spread(v) { // 10 bits, two zeros after each
  v = (v | (v << 16)) & 0x030000ff; v = (v | (v << 8)) & 0x0300f00f; v = (v | (v << 4)) & 0x030c30c3;
  return (v | (v << 2)) & 0x09249249;
}

function alongCurve(xyz, n, low, size) { // rows in Morton order; and how many cells of each level hold a point
  let keys = new Uint32Array(n), rows = new Uint32Array(n), keys2 = new Uint32Array(n), rows2 = new Uint32Array(n);
  const k = 1023.999 / (size || 1);
  for (let i = 0, j = 0; i < n; i++, j += 3) {
    keys[i] = spread((xyz[j] - low[0]) * k) | (spread((xyz[j + 1] - low[1]) * k) << 1) | (spread((xyz[j + 2] - low[2]) * k) << 2);
    rows[i] = i;
  }
  const count = new Uint32Array(1024);
  for (let shift = 0; shift < 30; shift += 10) {
    count.fill(0);
    for (let i = 0; i < n; i++) count[(keys[i] >>> shift) & 1023]++;
    for (let b = 0, sum = 0; b < 1024; b++) { const c = count[b]; count[b] = sum; sum += c; }
    for (let i = 0; i < n; i++) {
      const to = count[(keys[i] >>> shift) & 1023]++;
      keys2[to] = keys[i]; rows2[to] = rows[i];
    }
    [keys, keys2, rows, rows2] = [keys2, keys, rows2, rows];
  }
  const cells = new Array(11).fill(n ? 1 : 0);
  for (let i = 1; i < n; i++) {
    const change = keys[i] ^ keys[i - 1];
    if (change) for (let level = Math.max(1, 10 - Math.floor((31 - Math.clz32(change)) / 3)); level <= 10; level++) cells[level]++;
  }
  return {rows, cells};
}

// Mean distance of neighbours on a surface, from the finest level whose cells hold four points or more.
function spacingOf(cells, n, size) {
  let level = 0;
  while (level < 10 && n / cells[level + 1] >= 4) level++;
  return Math.sqrt((cells[level] * (size / 2 ** level) ** 2 * 0.7) / Math.max(1, n)) || size || 1;
}

const VERTEX = `
attribute float value;
uniform float low, high, size, half_; uniform vec4 slab; uniform sampler2D bar; uniform vec3 unknown, ground;
varying vec3 colour;
void main() {
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
  float t = clamp((value - low) / max(high - low, 1e-30), 0.0, 1.0);
  colour = value > 1e37 ? unknown : texture2D(bar, vec2(t, 0.5)).rgb;
  gl_PointSize = size;
  if (half_ >= 0.0 && abs(dot(position, slab.xyz) - slab.w) > half_) colour = mix(colour, ground, 0.82);
}`;
const FRAGMENT = `
uniform float size; varying vec3 colour;
void main() {
  if (size > 3.0 && length(gl_PointCoord - 0.5) > 0.5) discard;
  gl_FragColor = vec4(colour, 1.0);
}`;

class Cloud {
  constructor(scene) {
    const n = (this.count = scene.points), stretch = scene.stretch;
    this.xyz = scene.xyz; // as shown: heights may be stretched
    if (stretch.some(s => s !== 1)) this.xyz = scene.xyz.map((v, i) => v * stretch[i % 3]);
    const low = [0, 1, 2].map(k => scene.low[k] * stretch[k]), high = [0, 1, 2].map(k => scene.high[k] * stretch[k]);
    const size = Math.max(...high.map((h, k) => h - low[k]), 0);
    const {rows, cells} = alongCurve(this.xyz, n, low, size);
    this.spacing = spacingOf(cells, n, size);
    this.rows = new Uint32Array(n); // row of the file at each place of the buffers
    this.placed = new Float32Array(3 * n);
    this.values = new Float32Array(n);
    this.group = new THREE.Group();
    this.material = new THREE.ShaderMaterial({vertexShader: VERTEX, fragmentShader: FRAGMENT,
      transparent: true, blending: 0, uniforms: { // opaque, but after sheets and meshes, which must not tint them
     
      low: {value: 0}, high: {value: 1}, size: {value: 2}, half_: {value: -1}, slab: {value: new THREE.Vector4()}, bar: {value: null},
      unknown: {value: new THREE.Vector3()}, ground: {value: new THREE.Vector3()}}});
    this.chunks = [];
    const position = new THREE.BufferAttribute(this.placed, 3);
    this.attribute = new THREE.BufferAttribute(this.values, 1);
    for (let start = 0; start < n; start += CHUNK) this.chunks.push(this.chunk(rows, start, Math.min(CHUNK, n - start), position));
  }

  chunk(rows, start, m, position) {
    const bits = Math.ceil(Math.log2(Math.max(2, m))), low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (let i = 0, to = start; i < 1 << bits; i++) {
      let r = 0;
      for (let b = 0; b < bits; b++) r |= ((i >> b) & 1) << (bits - 1 - b);
      if (r >= m) continue;
      const row = rows[start + r];
      this.rows[to] = row;
      for (let k = 0; k < 3; k++) {
        const v = (this.placed[3 * to + k] = this.xyz[3 * row + k]);
        if (v < low[k]) low[k] = v;
        if (v > high[k]) high[k] = v;
      }
      to++;
    }
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", position);
    geometry.setAttribute("value", this.attribute);
    const centre = new THREE.Vector3(...low.map((l, k) => (l + high[k]) / 2));
    const sphere = (geometry.boundingSphere = new THREE.Sphere(centre, Math.hypot(...low.map((l, k) => (high[k] - l) / 2)) + 1e-6));
    const points = new THREE.Points(geometry, this.material);
    this.group.add(points);
    return {start, m, sphere, geometry, points};
  }

  // Colour by a column between two values.
  show(column, low, high) {
    if (column !== this.column) {
      const {rows, values, count} = this, from = column.values;
      for (let i = 0; i < count; i++) { const v = from[rows[i]]; values[i] = v === v ? v : 3e38; }
      this.attribute.needsUpdate = true;
      const bytes = barOf(column), bar = new THREE.DataTexture(bytes, bytes.length / 4, 1);
      bar.needsUpdate = true;
      if (this.material.uniforms.bar.value) this.material.uniforms.bar.value.dispose();
      this.material.uniforms.bar.value = bar;
      this.column = column;
    }
    Object.assign(this.material.uniforms.low, {value: low});
    Object.assign(this.material.uniforms.high, {value: high});
  }

  // Draw about `budget` of the points in view, evenly; how many that are, and how many are in view.
  detail(frustum, budget) {
    const seen = this.chunks.filter(c => (c.points.visible = frustum.intersectsSphere(c.sphere)));
    const within = seen.reduce((sum, c) => sum + c.m, 0), share = Math.min(1, budget / Math.max(1, within));
    let drawn = 0;
    for (const c of seen) {
      const part = share === 1 ? c.m : Math.max(1, Math.round(c.m * share));
      c.geometry.setDrawRange(c.start, part);
      drawn += part;
    }
    return {drawn, within, share};
  }

  // Row of the point in front at a place of the screen, null where there is none. `view` is {right, up, forward, target}, lengths in mm.
  pick(view, a, b, reach, slab) {
    const {right: r, up: u, forward: f, target: t} = view, A = t.dot(r) + a, B = t.dot(u) + b, found = [];
    let front = Infinity;
    for (const {start, m, sphere} of this.chunks) {
      const c = sphere.center, wide = sphere.radius + reach;
      if (Math.abs(c.dot(r) - A) > wide || Math.abs(c.dot(u) - B) > wide) continue;
      const p = this.placed;
      for (let i = start, j = 3 * start; i < start + m; i++, j += 3) {
        const x = p[j], y = p[j + 1], z = p[j + 2];
        const dx = x * r.x + y * r.y + z * r.z - A;
        if (dx > reach || dx < -reach) continue;
        const dy = x * u.x + y * u.y + z * u.z - B, off = dx * dx + dy * dy;
        if (off > reach * reach) continue;
        if (slab && Math.abs(x * slab.normal.x + y * slab.normal.y + z * slab.normal.z - slab.offset) > slab.half) continue;
        const depth = x * f.x + y * f.y + z * f.z;
        if (depth < front) front = depth;
        found.push([off, depth, this.rows[i]]);
      }
    }
    const behind = front + Math.max(2 * reach, 4 * this.spacing); // of the surface in front, not of one behind it
    let best = null;
    for (const each of found) if (each[1] <= behind && (best === null || each[0] < best[0])) best = each;
    return best && best[2];
  }

  // Rows within a slab.
  within(slab) {
    const {normal: {x: nx, y: ny, z: nz}, offset, half} = slab, p = this.xyz, rows = [];
    for (let i = 0, j = 0; i < this.count; i++, j += 3) if (Math.abs(p[j] * nx + p[j + 1] * ny + p[j + 2] * nz - offset) <= half) rows.push(i);
    return rows;
  }

  point(row) { return new THREE.Vector3(this.xyz[3 * row], this.xyz[3 * row + 1], this.xyz[3 * row + 2]); }
}
