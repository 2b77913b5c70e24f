// From where the scene is seen: in parallel projection, so that a length is the same wherever it lies and the scale bar holds everywhere.

const SIDES = { // what is right and down on the screen
  tilted: null, "along x": ["y", "z"], "along y": ["x", "z"], "along z": ["x", "y"],
};
const UNIT = {x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1]};

class View {
  constructor(low, high, first, places) {
    this.places = places; // that are to be in view
    this.low = low; this.high = high;
    this.first = first; // [right, down], of the view to begin with
    this.camera = new THREE.OrthographicCamera();
    this.camera.matrixAutoUpdate = false;
    this.frustum = new THREE.Frustum();
    this.width = this.height = 1;
    this.target = new THREE.Vector3();
    this.reach = Math.max(1e-6, low.distanceTo(high));
    this.turned = new THREE.Quaternion();
    this.look(...first);
    this.fit();
  }

  // Look along right x down.
  look(right, down) {
    const r = new THREE.Vector3(...right).normalize(), u = new THREE.Vector3(...down).normalize().negate();
    this.turned.setFromRotationMatrix(new THREE.Matrix4().makeBasis(r, u, new THREE.Vector3().crossVectors(r, u)));
    this.place();
  }

  fit() {
    const span = way => this.places.reduce(([a, b], p) => { const d = p.dot(way); return [Math.min(a, d), Math.max(b, d)]; }, [Infinity, -Infinity]);
    this.target.addVectors(this.low, this.high).multiplyScalar(0.5);
    const [wide, tall] = [this.right, this.up].map(way => {
      const [from, to] = this.places.length ? span(way) : [-1, 1];
      this.target.addScaledVector(way, (from + to) / 2 - this.target.dot(way));
      return Math.max(1e-9, to - from);
    });
    this.scale = Math.min((this.width - 2 * Math.min(90, 0.14 * this.width)) / wide, (this.height - 84) / tall); // px per mm
    this.scale = Math.max(this.scale, 1e-9);
    this.fitted = true;
    this.place();
  }

  resize(width, height) {
    const grown = Math.min(width / this.width, height / this.height);
    this.width = width; this.height = height;
    if (this.fitted) this.fit();
    else { this.scale *= grown; this.place(); }
  }

  place() {
    const q = this.turned;
    this.right = new THREE.Vector3(1, 0, 0).applyQuaternion(q);
    this.up = new THREE.Vector3(0, 1, 0).applyQuaternion(q);
    this.forward = new THREE.Vector3(0, 0, -1).applyQuaternion(q);
    const far = 2 * this.reach + this.target.distanceTo(this.low) + this.target.distanceTo(this.high), c = this.camera;
    const x = this.width / 2 / (this.scale || 1), y = this.height / 2 / (this.scale || 1);
    Object.assign(c, {left: -x, right: x, top: y, bottom: -y, near: 0, far: 2 * far});
    c.matrix.makeBasis(this.right, this.up, this.forward.clone().negate()).setPosition(this.target.clone().addScaledVector(this.forward, -far));
    c.matrixWorld.copy(c.matrix);
    c.matrixWorldInverse.copy(c.matrix).invert();
    c.matrixWorldNeedsUpdate = true;
    c.updateProjectionMatrix();
    this.frustum.setFromProjectionMatrix(new THREE.Matrix4().multiplyMatrices(c.projectionMatrix, c.matrixWorldInverse));
  }

  turn(dx, dy, roll = 0) { // rad about the screen's upright, its level and its sight
    const by = (axis, angle) => new THREE.Quaternion().setFromAxisAngle(axis, angle);
    this.turned.premultiply(by(this.up, -dx)).premultiply(by(this.right, -dy)).premultiply(by(this.forward, roll)).normalize();
    this.fitted = false;
    this.place();
  }

  move(dx, dy) { // px
    this.target.addScaledVector(this.right, -dx / this.scale).addScaledVector(this.up, dy / this.scale);
    this.fitted = false;
    this.place();
  }

  zoom(factor, x = this.width / 2, y = this.height / 2) { // what lies under (x, y) stays there
    const limits = [this.height / (40 * this.reach), 4000 * this.height / this.reach];
    factor = Math.min(limits[1] / this.scale, Math.max(limits[0] / this.scale, factor));
    const [dx, dy] = [x - this.width / 2, y - this.height / 2];
    this.target.addScaledVector(this.right, (dx / this.scale) * (1 - 1 / factor)).addScaledVector(this.up, (-dy / this.scale) * (1 - 1 / factor));
    this.scale *= factor;
    this.fitted = false;
    this.place();
  }

  turnAbout(point) { this.target.copy(point); this.fitted = false; this.place(); }

  // Place on the screen, px, and depth, mm.
  project(p) {
    const q = new THREE.Vector3().subVectors(p, this.target);
    return [this.width / 2 + q.dot(this.right) * this.scale, this.height / 2 - q.dot(this.up) * this.scale, q.dot(this.forward)];
  }

  offsets(x, y) { return [(x - this.width / 2) / this.scale, (this.height / 2 - y) / this.scale]; }

  // Point on the plane of the target, facing the viewer.
  at(x, y) {
    const [a, b] = this.offsets(x, y);
    return this.target.clone().addScaledVector(this.right, a).addScaledVector(this.up, b);
  }
}
