// What is written over the scene: axes, scale bar, the box with its figures, what was picked.

class Overlay {
  constructor(canvas) { this.canvas = canvas; this.pen = canvas.getContext("2d"); }

  draw(view, told) {
    const pen = this.pen, ratio = window.devicePixelRatio || 1;
    this.ink = told.ink; this.halo = told.ground;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, view.width, view.height);
    pen.font = "12px system-ui, sans-serif";
    pen.lineJoin = pen.lineCap = "round";
    for (const layer of told.layers) if (layer.shown && layer.bold) this.bold(view, layer);
    if (told.box) this.box(view, told);
    this.axes(view, told.dark);
    this.bar(view);
    this.picked(view, told);
  }

  text(words, x, y, colour = this.ink, align = "left") {
    const pen = this.pen;
    pen.textAlign = align; pen.textBaseline = "middle";
    pen.lineWidth = 3; pen.strokeStyle = this.halo; pen.strokeText(words, x, y);
    pen.fillStyle = colour; pen.fillText(words, x, y);
  }

  line(points, colour, width = 1, dash = []) {
    const pen = this.pen;
    pen.beginPath();
    points.forEach(([x, y], k) => (k ? pen.lineTo(x, y) : pen.moveTo(x, y)));
    pen.setLineDash(dash); pen.lineWidth = width; pen.strokeStyle = colour; pen.stroke(); pen.setLineDash([]);
  }

  bold(view, layer) {
    const s = layer.segments, p = new THREE.Vector3(), axes = layer.role === "axes";
    for (let i = 0; i < s.length; i += 6) {
      const name = axes ? "xyz"[i / 6] : "", colour = axes ? layer.colours[name] : layer.colour;
      const ends = [0, 3].map(k => view.project(p.set(s[i + k], s[i + k + 1], s[i + k + 2])));
      this.line(ends, colour, 2.5);
      if (axes) this.text(name, ends[1][0] + 6, ends[1][1] - 6, colour);
    }
  }

  axes(view, dark) {
    const at = [44, view.height - 46];
    const ends = Object.entries(UNIT).map(([name, v]) => [name, new THREE.Vector3(...v)]);
    ends.sort((a, b) => b[1].dot(view.forward) - a[1].dot(view.forward));
    for (const [name, v] of ends) {
      const colour = PARTS[name][dark ? 1 : 0], x = 26 * v.dot(view.right), y = -26 * v.dot(view.up), long = Math.hypot(x, y);
      this.line([at, [at[0] + x, at[1] + y]], colour, 2.5);
      if (long > 6) this.text(name, at[0] + x * (1 + 9 / long), at[1] + y * (1 + 9 / long), colour, "center");
    }
  }

  bar(view) {
    const step = roundStep(Math.min(90, view.width / 5) / view.scale), long = step * view.scale;
    const x = view.width - 20 - long, y = view.height - 20;
    for (const [colour, width] of [[this.halo, 5], [this.ink, 2]]) this.line([[x, y - 5], [x, y], [x + long, y], [x + long, y - 5]], colour, width);
    this.words = step < 0.0995 ? `${+(step * 1000).toPrecision(3)} µm` : `${+step.toPrecision(3)} mm`;
    this.text(this.words, x + long / 2, y - 12, this.ink, "center");
  }

  // Box around the points; on three of its edges, those furthest out, places in mm.
  box(view, told) {
    const {low, high} = told.box, names = ["x", "y", "z"], middle = view.project(new THREE.Vector3().addVectors(low, high).multiplyScalar(0.5));
    names.forEach((name, axis) => {
      const [b, c] = names.filter(n => n !== name), edges = [];
      for (const vb of [low[b], high[b]]) for (const vc of [low[c], high[c]]) {
        const ends = [low[name], high[name]].map(v => new THREE.Vector3().copy(low).setComponent(axis, v));
        for (const end of ends) { end[b] = vb; end[c] = vc; }
        const seen = ends.map(end => view.project(end));
        this.line(seen, told.edge, 1);
        edges.push({ends, seen});
      }
      const [[x0, y0], [x1, y1]] = edges[0].seen, long = Math.hypot(x1 - x0, y1 - y0), span = high[name] - low[name];
      if (long < 50 || !(span > 0)) return;
      const level = Math.abs(x1 - x0) >= Math.abs(y1 - y0);
      const out = ({seen: [p, q]}) => (level ? p[1] + q[1] : -(p[0] + q[0])) / 2;
      const edge = edges.reduce((best, each) => (out(each) > out(best) ? each : best));
      const [p, q] = edge.seen, normal = [-(q[1] - p[1]) / long, (q[0] - p[0]) / long];
      const side = Math.sign(normal[0] * ((p[0] + q[0]) / 2 - middle[0]) + normal[1] * ((p[1] + q[1]) / 2 - middle[1])) || 1;
      const [nx, ny] = normal.map(v => v * side), factor = told.stretch[axis], shift = told.centre[axis];
      const from = low[name] / factor + shift, to = high[name] / factor + shift, step = roundStep(((to - from) * (level ? 58 : 30)) / long);
      const colour = PARTS[name][told.dark ? 1 : 0];
      for (let v = Math.ceil(from / step - 1e-9) * step; v <= to + 1e-9 * step; v += step) {
        const t = (v - from) / (to - from), x = p[0] + t * (q[0] - p[0]), y = p[1] + t * (q[1] - p[1]);
        this.line([[x, y], [x + 5 * nx, y + 5 * ny]], colour, 1.5);
        const text = figure(v, decimalsOf(step)), wide = 4 + this.pen.measureText(text).width / 2;
        this.text(text, x + nx * (9 + wide), y + ny * 16, colour, "center");
      }
      this.text(name, (p[0] + q[0]) / 2 + nx * 44, (p[1] + q[1]) / 2 + ny * 34, colour, "center");
    });
  }

  picked(view, told) {
    const places = told.picked.map(p => view.project(p));
    if (places.length === 2) { this.line(places, this.halo, 5); this.line(places, told.mark, 2); }
    places.forEach(([x, y], k) => {
      const pen = this.pen;
      for (const [colour, width] of [[this.halo, 5], [told.mark, 2]]) {
        pen.beginPath(); pen.arc(x, y, 7, 0, 7); pen.lineWidth = width; pen.strokeStyle = colour; pen.stroke();
      }
      if (told.picked.length > 1) this.text("AB"[k], x + 11, y - 11, told.mark);
    });
    if (told.distance && places.length === 2) {
      this.text(told.distance, (places[0][0] + places[1][0]) / 2, (places[0][1] + places[1][1]) / 2 - 12, told.mark, "center");
    }
    if (told.drawn) {
      const ends = told.drawn;
      if (told.drawing === "region") {
        const [[a, b], [c, d]] = ends;
        this.line([[a, b], [c, b], [c, d], [a, d], [a, b]], told.mark, 2);
      } else this.line(ends, told.mark, 2, [6, 4]);
    }
    if (told.cross) {
      const [x, y] = [view.width / 2, view.height / 2];
      for (const [colour, width] of [[this.halo, 4], [told.mark, 1.5]]) for (const d of [[1, 0], [0, 1]]) {
        for (const s of [-1, 1]) this.line([[x + s * 5 * d[0], y + s * 5 * d[1]], [x + s * 14 * d[0], y + s * 14 * d[1]]], colour, width);
      }
    }
  }
}
