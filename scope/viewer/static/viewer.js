// <scope-cloud>: a cloud or a rig to be turned, read and measured. Its scene is in a <script class="scene"> inside it, or at its `src`.

const LIVE = [], MOST = 8; // viewers with a WebGL context, of which a browser gives about 16 to all its pages
const DARK = matchMedia("(prefers-color-scheme: dark)");

class ScopeCloud extends HTMLElement {
  static observedAttributes = ["src"];

  connectedCallback() {
    this.watching = new IntersectionObserver(seen => {
      this.near = seen[seen.length - 1].isIntersecting;
      if (this.near) this.begin();
    }, {rootMargin: "400px"});
    this.watching.observe(this);
  }

  disconnectedCallback() {
    this.watching.disconnect();
    this.retire();
  }

  attributeChangedCallback(name, before, now) {
    if (before === null || before === now) return;
    this.bytes = null;
    this.retire();
    if (this.near) this.begin();
  }

  // Give back what it holds; it begins again when it comes near.
  retire() {
    this.begun = null; // what is being loaded for it comes too late
    this.classList.remove("live");
    delete this.dataset.ready;
    if (LIVE.includes(this)) LIVE.splice(LIVE.indexOf(this), 1);
    if (this.shadowRoot) this.shadowRoot.replaceChildren(make("style", {textContent: STYLE}), make("slot"));
    if (!this.renderer) return;
    this.sizes.disconnect();
    document.removeEventListener("pointerdown", this.outside, true);
    DARK.removeEventListener("change", this.themed);
    this.renderer.dispose();
    this.renderer.forceContextLoss();
    this.renderer = null;
  }

  async begin() {
    if (this.begun) return;
    const begun = (this.begun = {}), root = this.shadowRoot || this.attachShadow({mode: "open"}), note = make("p", {textContent: "Loading the cloud…"});
    root.replaceChildren(make("style", {textContent: STYLE}), make("slot"), note);
    delete this.dataset.failed;
    try {
      const own = this.querySelector("script.scene");
      if (own) { this.bytes = bytesOf(own.textContent.trim()); own.remove(); }
      let bytes = this.bytes;
      if (!bytes) {
        const answer = await fetch(this.getAttribute("src"));
        if (!answer.ok) throw new Error(`the cloud did not come (${answer.status})`);
        bytes = new Uint8Array(await answer.arrayBuffer());
      }
      const scene = await readScene(bytes);
      if (this.begun !== begun) return;
      const far = LIVE.length >= MOST && LIVE.find(viewer => !viewer.near);
      if (far) far.retire();
      this.scene = scene;
      this.stage = make("div", {className: "stage"});
      this.renderer = new THREE.WebGLRenderer({antialias: true, powerPreference: "high-performance"});
    } catch (error) {
      if (this.begun !== begun) return;
      note.textContent = `No 3-D here (${String(error.message || error).slice(0, 120)}): a still picture.`;
      this.dataset.failed = "yes";
      return;
    }
    LIVE.push(this);
    this.build(root);
    note.remove();
    this.draw();
    requestAnimationFrame(() => { this.dataset.ready = performance.now().toFixed(1); });
  }

  build(root) {
    const {scene} = this;
    Object.assign(this, {picked: [], mode: "point", drawn: null, slab: null, theme: null, settling: null});
    this.cloud = new Cloud(scene);
    this.parts = new Parts(scene.layers, scene.centre, scene.stretch);
    const box = [scene.low, scene.high].map(v => new THREE.Vector3(...v.map((x, k) => x * scene.stretch[k])));
    this.box = scene.points ? {low: box[0], high: box[1]} : null;
    const [low, high] = box.map(v => v.clone()), places = [];
    for (const {segments, mesh} of this.parts.layers) {
      const all = segments || mesh.geometry.attributes.position.array;
      for (let i = 0; i < all.length; i += 3) { const p = new THREE.Vector3(all[i], all[i + 1], all[i + 2]); low.min(p); high.max(p); places.push(p); }
    }
    this.view = new View(low, high, scene.look, this.box ? [...places, ...this.corners()] : places);
    this.world = new THREE.Scene();
    this.world.add(this.parts.group, this.cloud.group);
    this.canvas = make("canvas", {className: "over", tabIndex: 0, data: {role: "application", "aria-label": this.getAttribute("label") || "3-D view; keys: ?"}});
    this.overlay = new Overlay(this.canvas);
    this.panel = new Panel(this);
    this.profile = new Profile(this.panel.canvas, row => this.choose(row));
    this.stage.append(this.renderer.domElement, this.canvas, this.panel.scale, this.panel.hint, this.panel.count, this.panel.help);
    root.append(make("div", {className: "viewer"}, this.panel.bar, make("div", {className: "body"}, this.stage, this.panel.side)));
    this.classList.add("live");
    this.still = this.moving = 250000; // points drawn while it moves; more follow when it is still
    this.renderer.info.autoReset = true;
    this.sizes = new ResizeObserver(() => this.resize());
    this.sizes.observe(this.stage);
    this.themed = () => this.recolour();
    DARK.addEventListener("change", this.themed);
    if (scene.columns.length) {
      const first = Math.max(0, scene.columns.findIndex(c => c.name === scene.shown));
      this.panel.scalar.value = first;
      this.showColumn(first);
    }
    this.resize();
    this.recolour();
    this.setMode("point");
    addControls(this);
  }

  resize() {
    const {clientWidth: width, clientHeight: height} = this.stage, ratio = Math.min(3, window.devicePixelRatio || 1);
    if (!width || !height) return;
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height, false);
    Object.assign(this.canvas, {width: width * ratio, height: height * ratio});
    this.view.resize(width, height);
    this.profile.draw();
    this.draw();
  }

  recolour() {
    const style = getComputedStyle(this.stage), value = name => style.getPropertyValue(name).trim();
    this.theme = {ink: value("--ink"), soft: value("--soft"), ground: value("--ground"), edge: value("--edge"), dark: value("--dark") === "1"};
    this.theme.mark = partColour({role: "mark"}, this.theme.dark);
    this.renderer.setClearColor(new THREE.Color(this.theme.ground), 1);
    const vector = text => channels(text).map(c => c / 255), {unknown, ground} = this.cloud.material.uniforms;
    unknown.value.set(...vector(this.theme.dark ? "#59636f" : "#8d97a3"));
    ground.value.set(...vector(this.theme.ground));
    this.parts.colour(this.theme.dark);
    for (const layer of this.parts.layers) {
      if (!layer.swatch) continue;
      layer.swatch.style.background = layer.colours ? `linear-gradient(90deg, ${Object.values(layer.colours).map((c, k) => `${c} ${33 * k}% ${33 * k + 33}%`).join(",")})` : layer.colour;
    }
    if (this.slab) this.cut();
    this.draw();
  }

  // Draw when the browser is ready to; `moving` first with fewer points.
  draw(moving = false) {
    if (moving) {
      this.still = this.moving;
      clearTimeout(this.settling);
      this.settling = setTimeout(() => { this.settling = null; this.draw(); }, 160);
    }
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.paint(); });
  }

  paint() {
    if (!this.renderer) return;
    const {view, cloud, renderer} = this, moves = Boolean(this.settling), uniforms = cloud.material.uniforms;
    const {drawn, within, share} = cloud.detail(view.frustum, moves ? this.moving : this.still);
    const ratio = renderer.getPixelRatio();
    uniforms.size.value = Math.min(7 * ratio, Math.max(1.6 * ratio, (1.25 * cloud.spacing * view.scale * ratio) / Math.sqrt(Math.max(share, 1e-3))));
    const from = performance.now();
    renderer.render(this.world, view.camera);
    if (moves) { // as many points as this machine turns at 20 to 40 pictures a second
      const gl = renderer.getContext();
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4)); // waits until it is drawn
      const took = performance.now() - from;
      if (took > 40) this.moving = Math.max(20000, this.moving * Math.max(0.5, 30 / took));
      else if (took < 15) this.moving = Math.min(Math.max(cloud.count, 20000), this.moving * 1.2);
    }
    const {box, scene, parts, picked, theme} = this;
    this.overlay.draw(view, {...theme, layers: parts.layers, box, stretch: scene.stretch, centre: scene.centre, picked: picked.map(row => cloud.point(row)),
      distance: picked.length === 2 ? `${figure(this.distance, scene.decimals)} mm` : "", drawn: this.drawn, drawing: this.mode, cross: this.byKeys && this.active});
    if (scene.points) {
      const shown = drawn < within ? `${drawn.toLocaleString("en")} of ${within.toLocaleString("en")} points in view` : `${within.toLocaleString("en")} points in view`;
      const higher = scene.stretch[2] === 1 ? "" : `; z shown ${scene.stretch[2]} times larger`;
      this.panel.count.textContent = shown + higher;
      Object.assign(this.dataset, {drawn, within});
    }
    if (!moves && drawn < within) { this.still *= 2; this.draw(); }
  }

  // --- colours

  showColumn(k) {
    this.column = this.scene.columns[k];
    this.usualRange();
  }

  usualRange() { this.limits = [...this.column.usual]; this.shade(); }
  wholeRange() { this.limits = [...this.column.whole]; this.shade(); }
  setRange(k, value) { if (Number.isFinite(value)) { this.limits[k] = value; this.shade(); } }

  shade() {
    const {column, limits} = this, names = column.kind === "names";
    this.cloud.show(column, ...(names ? [-0.5, column.names.length - 0.5] : limits));
    this.panel.showScale(column, ...limits);
    this.draw();
  }

  // --- picking

  setMode(mode) {
    this.mode = mode;
    this.drawn = null;
    for (const button of this.panel.modes) button.setAttribute("aria-pressed", String(button.dataset.mode === mode));
    this.picked = mode === "distance" ? [] : this.picked.slice(-1);
    if (mode === "distance") this.panel.tell("Click two points");
    this.panel.section.hidden = mode !== "section";
    if (mode === "section") this.sectionAcross(this.panel.across.value === "drawn" ? "x" : this.panel.across.value);
    else { this.slab = null; this.cloud.material.uniforms.half_.value = -1; }
    if (mode === "region") this.lookAlong("along z");
    this.panel.showPicked(this.picked);
    this.draw();
  }

  pickAt(x, y, reach = 9) {
    const from = performance.now(), [a, b] = this.view.offsets(x, y);
    const row = this.cloud.pick(this.view, a, b, reach / this.view.scale, this.slab);
    this.dataset.pickMs = (performance.now() - from).toFixed(2);
    return row;
  }

  choose(row) {
    if (row === null) return;
    if (this.mode === "distance" && this.picked.length === 1 && this.picked[0] === row) return; // the second half of a double click
    this.picked = this.mode === "distance" && this.picked.length === 1 ? [...this.picked, row] : [row];
    this.panel.showPicked(this.picked);
    this.tellPicked();
    this.draw();
  }

  get distance() {
    const [a, b] = this.picked.map(row => this.scene.xyz.subarray(3 * row, 3 * row + 3));
    return Math.hypot(b[0] - a[0], b[1] - a[1], b[2] - a[2]);
  }

  tellPicked() {
    const {scene} = this, rows = this.picked;
    const detail = rows.map(row => ({row, point: [0, 1, 2].map(k => scene.xyz[3 * row + k] + scene.centre[k]),
      values: Object.fromEntries(scene.columns.map(c => [c.name, c.kind === "names" ? named(c, c.values[row]) : c.values[row]]))}));
    this.dispatchEvent(new CustomEvent("scope-pick", {detail: {picked: detail, distance: rows.length === 2 ? this.distance : null}, bubbles: true, composed: true}));
  }

  forget() { this.picked = []; this.drawn = null; this.panel.showPicked([]); this.draw(); }

  // --- sight

  reset() {
    this.view.look(...this.scene.look);
    this.view.fit();
    this.draw();
  }

  lookAlong(side) {
    if (side === "at the points") {
      const all = this.view.places;
      this.view.places = this.corners();
      this.view.fit();
      Object.assign(this.view, {places: all, fitted: false});
      this.draw();
    }
    if (!(side in SIDES)) return;
    const names = SIDES[side];
    this.view.look(...(names ? names.map(n => UNIT[n]) : this.scene.look));
    this.view.fit();
    this.draw();
  }

  wholeScreen() {
    if (document.fullscreenElement) document.exitFullscreen();
    else if (this.requestFullscreen) this.requestFullscreen().catch(() => {});
  }

  // --- section

  sectionAcross(axis) {
    const k = "xyz".indexOf(axis), across = {x: ["y", "z"], y: ["x", "z"], z: ["x", "y"]}[axis];
    this.panel.across.value = axis;
    const normal = new THREE.Vector3(...UNIT[axis]);
    this.setSlab(normal, (this.box.low.getComponent(k) + this.box.high.getComponent(k)) / 2, across.map(n => new THREE.Vector3(...UNIT[n])), across.map(n => `${n}, mm`), k);
  }

  // Through the points under both ends of a line drawn on the screen, along the axis that points most nearly at the viewer.
  sectionThrough(...ends) {
    const {view, cloud} = this;
    const [from, to] = ends.map(([x, y]) => { const row = this.pickAt(x, y, 14); return row === null ? view.at(x, y) : cloud.point(row); });
    const axis = ["x", "y", "z"].reduce((best, n) => (Math.abs(view.forward[n]) > Math.abs(view.forward[best]) ? n : best));
    const depth = new THREE.Vector3(...UNIT[axis]), along = to.sub(from);
    along.addScaledVector(depth, -along.dot(depth)).normalize();
    this.drawn = null;
    if (!along.lengthSq()) return;
    const normal = new THREE.Vector3().crossVectors(along, depth).normalize();
    this.panel.across.value = "drawn";
    this.setSlab(normal, normal.dot(from), [along, depth], ["along the line, mm", `${axis}, mm`], -1, along.dot(from));
  }

  setSlab(normal, offset, along, labels, axis, zero = 0) {
    const places = this.corners().map(p => p.dot(normal)), half = this.slab ? this.slab.half : Math.max(1.5 * this.cloud.spacing, this.view.reach / 1000);
    this.slab = {normal, offset, along, labels, axis, zero, half, low: Math.min(...places), high: Math.max(...places)};
    this.cut();
  }

  corners() {
    const {low, high} = this.box;
    return [...Array(8).keys()].map(k => new THREE.Vector3(k & 1 ? high.x : low.x, k & 2 ? high.y : low.y, k & 4 ? high.z : low.z));
  }

  placeSection(share) { const s = this.slab; s.offset = s.low + share * (s.high - s.low); this.cut(); }

  placeSectionAt(mm) {
    const {slab, scene} = this;
    if (!Number.isFinite(mm)) return;
    slab.offset = slab.axis >= 0 ? (mm - scene.centre[slab.axis]) * scene.stretch[slab.axis] : mm;
    this.cut();
  }

  thickenSection(mm) { if (mm > 0) { this.slab.half = (mm / 2) * (this.slab.axis >= 0 ? this.scene.stretch[this.slab.axis] : 1); this.cut(); } }

  cut() {
    const {slab, scene, panel, cloud} = this, {half_, slab: plane} = cloud.material.uniforms;
    half_.value = slab.half;
    plane.value.set(slab.normal.x, slab.normal.y, slab.normal.z, slab.offset);
    const rows = cloud.within(slab), absolute = slab.axis >= 0;
    const ways = slab.along.map(v => new THREE.Vector3(...v.toArray().map((x, k) => x / scene.stretch[k])).normalize());
    const at = (way, k) => Float64Array.from(rows, row => {
      const r = 3 * row, c = absolute || k === 1 ? scene.centre : [0, 0, 0];
      return (scene.xyz[r] + c[0]) * way.x + (scene.xyz[r + 1] + c[1]) * way.y + (scene.xyz[r + 2] + c[2]) * way.z - (k === 0 && !absolute ? slab.zero : 0);
    });
    const {ink, soft, edge, mark, dark} = this.theme || {};
    this.profile.show(rows, at(ways[0], 0), at(ways[1], 1), slab.labels, {ink, soft, edge, mark, dot: dark ? "#7db4f0" : "#1f5fa8"},
      scene.look[1]["xyz".indexOf(slab.labels[1][0])] > 0); // z away from the camera: what is nearer to it stands higher
    const where = absolute ? slab.offset / scene.stretch[slab.axis] + scene.centre[slab.axis] : slab.offset;
    panel.where.value = +where.toFixed(4);
    panel.thick.value = +((2 * slab.half) / (absolute ? scene.stretch[slab.axis] : 1)).toPrecision(4);
    panel.place.value = (1000 * (slab.offset - slab.low)) / (slab.high - slab.low || 1);
    panel.told.textContent = rows.length ? `${rows.length.toLocaleString("en")} points. Drag across the picture to cut along a line of your own.` : "No point lies within: make it thicker, or move it.";
    Object.assign(this.dataset, {sectionPoints: rows.length});
    this.dispatchEvent(new CustomEvent("scope-section", {detail: {points: rows.length, place: where}, bubbles: true, composed: true}));
    this.draw();
  }

  keepProfile() {
    const link = make("a", {href: URL.createObjectURL(new Blob([this.profile.csv()], {type: "text/csv"})), download: "profile.csv"});
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }

  // A rectangle drawn on the screen, seen along z: its sides in mm.
  regionOf([x0, y0], [x1, y1]) {
    const {scene} = this, [p, q] = [this.view.at(x0, y0), this.view.at(x1, y1)];
    const side = k => [p, q].map(v => v.getComponent(k) / scene.stretch[k] + scene.centre[k]).sort((a, b) => a - b);
    this.dispatchEvent(new CustomEvent("scope-region", {detail: {x: side(0), y: side(1)}, bubbles: true, composed: true}));
  }
}
customElements.define("scope-cloud", ScopeCloud);
