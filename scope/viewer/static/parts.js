// What is shown beside points: lines, sheets of light and meshes, each of which can be switched off.

const FLAT = {
  vertexShader: `uniform float back; varying vec3 seen;
    void main() { vec4 p = modelViewMatrix * vec4(position, 1.0); seen = p.xyz; gl_Position = projectionMatrix * (p - vec4(0.0, 0.0, back, 0.0)); }`,
  fragmentShader: `uniform vec3 colour; uniform float alpha; varying vec3 seen;
    void main() { vec3 n = normalize(cross(dFdx(seen), dFdy(seen))); gl_FragColor = vec4(colour * (0.45 + 0.55 * abs(n.z)), alpha); }`,
};

class Parts {
  constructor(layers, centre, stretch) {
    this.group = new THREE.Group();
    this.layers = layers.map(layer => {
      const place = xyz => Float32Array.from(xyz, (v, i) => (v - centre[i % 3]) * stretch[i % 3]);
      const made = {...layer, shown: layer.shown !== false, segments: layer.lines ? place(layer.lines) : null};
      const geometry = new THREE.BufferGeometry();
      if (layer.faces) {
        geometry.setAttribute("position", new THREE.BufferAttribute(place(layer.vertices), 3));
        geometry.setIndex(layer.faces);
        // A model hides what lies behind it, but no point that is a little within it: its depth is set back.
        geometry.computeBoundingSphere();
        const solid = layer.role === "model", back = solid ? 0.03 * geometry.boundingSphere.radius : 0;
        const material = new THREE.ShaderMaterial({...FLAT, transparent: true, depthWrite: solid, side: THREE.DoubleSide,
          uniforms: {colour: {value: new THREE.Vector3()}, alpha: {value: solid ? 1 : 0.3}, back: {value: back}}});
        made.mesh = new THREE.Mesh(geometry, material);
        made.mesh.renderOrder = -1;
        this.group.add(made.mesh);
      } else if (!layer.bold) {
        geometry.setAttribute("position", new THREE.BufferAttribute(made.segments, 3));
        made.mesh = new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({transparent: layer.role === "ray", opacity: 0.75}));
        this.group.add(made.mesh);
      } // bold lines are drawn over the scene: WebGL's are one pixel wide
      return made;
    });
  }

  colour(dark) {
    for (const layer of this.layers) {
      layer.colour = partColour(layer, dark);
      if (layer.role === "axes") layer.colours = Object.fromEntries(["x", "y", "z"].map(a => [a, PARTS[a][dark ? 1 : 0]]));
      if (!layer.mesh) continue;
      layer.mesh.visible = layer.shown;
      if (layer.faces) layer.mesh.material.uniforms.colour.value.set(...channels(layer.colour).map(c => c / 255));
      else layer.mesh.material.color.set(layer.colour);
    }
  }
}
