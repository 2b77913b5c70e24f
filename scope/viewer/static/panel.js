// Buttons, colour bar, legend and readings around the scene. Text of files is set as text, never as markup.

function make(tag, told = {}, ...children) {
  const {on, data, ...rest} = told, element = Object.assign(document.createElement(tag), rest);
  for (const [name, value] of Object.entries(data || {})) element.setAttribute(name, value);
  for (const [name, work] of Object.entries(on || {})) element.addEventListener(name, work);
  element.append(...children);
  return element;
}

const MODES = [
  ["point", "Point", "Click a point to read all its values (P)"],
  ["distance", "Distance", "Click two points to measure between them (D)"],
  ["section", "Section", "Cut by a plane and see the profile (S)"],
  ["region", "Region", "Draw a rectangle, seen along z (B)"],
];
const KEYS = [
  ["drag, arrow keys", "turn"], ["shift + drag, right button, two fingers, shift + arrows", "move"],
  ["wheel (after a click), pinch, + and -", "zoom"], ["click, Enter", "read the point under the pointer, or under the cross"],
  ["double click, C", "turn about this point"], ["X, Y, Z", "look along an axis"], ["R", "reset"],
  ["P, D, S", "point, distance, section"], ["[ and ]", "move the section"], ["F", "whole screen"], ["Escape", "forget what was picked, leave"],
];

class Panel {
  constructor(viewer) {
    const scene = viewer.scene;
    this.viewer = viewer;
    this.scalar = make("select", {data: {"aria-label": "colour by"}, on: {change: () => viewer.showColumn(+this.scalar.value)}},
      ...scene.columns.map((c, k) => make("option", {value: k, textContent: c.label + (c.unit ? `, ${c.unit}` : "")})));
    this.modes = MODES.filter(([name]) => name !== "region" || viewer.hasAttribute("region")).map(([name, label, title]) =>
      make("button", {type: "button", textContent: label, title, data: {"data-mode": name, "aria-pressed": "false"}, on: {click: () => viewer.setMode(name)}}));
    this.sides = make("select", {data: {"aria-label": "look"}, on: {change: () => { viewer.lookAlong(this.sides.value); this.sides.value = ""; }}},
      make("option", {value: "", textContent: "Look…"}), ...[...Object.keys(SIDES), ...(scene.points && scene.layers.length ? ["at the points"] : [])].map(s => make("option", {value: s, textContent: s})));
    const button = (label, title, work, name) => make("button", {type: "button", textContent: label, title, data: {"data-do": name}, on: {click: work}});
    this.help = make("div", {className: "help", hidden: true}, make("table", {}, ...KEYS.map(([k, t]) => make("tr", {}, make("th", {textContent: k}), make("td", {textContent: t})))));
    const bar = make("div", {className: "bar"});
    if (scene.columns.length) bar.append(make("label", {textContent: "Colour "}, this.scalar));
    if (scene.points) bar.append(make("span", {className: "modes", data: {role: "group", "aria-label": "what a click does"}}, ...this.modes));
    bar.append(this.sides, button("Reset", "As at the beginning (R)", () => viewer.reset(), "reset"),
      button("Full", "Whole screen (F)", () => viewer.wholeScreen(), "screen"), button("?", "Keys", () => { this.help.hidden = !this.help.hidden; }, "help"));
    this.scale = make("div", {className: "scale", hidden: !scene.columns.length, data: {role: "img"}});
    this.hint = make("div", {className: "hint", hidden: true});
    this.count = make("div", {className: "count", data: {"aria-live": "off"}});
    this.reading = make("div", {className: "reading", data: {role: "status", "aria-live": "polite"}});
    this.legend = make("div", {className: "legend"});
    this.section = this.sectionPanel();
    this.range = this.rangePanel();
    this.side = make("div", {className: "side"}, this.section, this.reading, this.legend, this.range);
    this.bar = bar;
    this.showLegend(scene.layers.length ? viewer.parts.layers : []);
    this.showPicked([]);
  }

  rangePanel() {
    const v = this.viewer, input = (label, k) => make("input", {type: "number", step: "any", data: {"aria-label": label}, on: {change: () => v.setRange(k, parseFloat(this.limits[k].value))}});
    this.limits = [input("colours from", 0), input("colours to", 1)];
    return make("details", {className: "range", hidden: !v.scene.columns.length}, make("summary", {textContent: "Range of the colours"}),
      make("div", {className: "fields"}, make("label", {textContent: "from "}, this.limits[0]), make("label", {textContent: "to "}, this.limits[1]),
        make("button", {type: "button", textContent: "all", title: "Smallest to largest value", on: {click: () => v.wholeRange()}}),
        make("button", {type: "button", textContent: "usual", title: "Without the furthest 2 % at either end", on: {click: () => v.usualRange()}})));
  }

  sectionPanel() {
    const v = this.viewer;
    this.across = make("select", {data: {"aria-label": "section across"}, on: {change: () => v.sectionAcross(this.across.value)}},
      ...["x", "y", "z"].map(a => make("option", {value: a, textContent: `across ${a}`})), make("option", {value: "drawn", textContent: "drawn", hidden: true}));
    this.place = make("input", {type: "range", min: 0, max: 1000, step: 1, data: {"aria-label": "place of the section"}, on: {input: () => v.placeSection(this.place.value / 1000)}});
    this.where = make("input", {type: "number", step: "any", data: {"aria-label": "place of the section, mm"}, on: {change: () => v.placeSectionAt(parseFloat(this.where.value))}});
    this.thick = make("input", {type: "number", step: "any", min: 0, data: {"aria-label": "thickness of the section, mm"}, on: {change: () => v.thickenSection(parseFloat(this.thick.value))}});
    this.canvas = make("canvas", {className: "profile", data: {role: "img", "aria-label": "profile of the section"}});
    this.told = make("div", {className: "told"});
    return make("div", {className: "section", hidden: true}, make("div", {className: "fields"}, this.across, make("label", {textContent: "at "}, this.where, " mm"),
      make("label", {textContent: "thick "}, this.thick, " mm"), make("button", {type: "button", textContent: "CSV", title: "Keep the profile as a table", on: {click: () => v.keepProfile()}})),
      this.place, this.canvas, this.told);
  }

  showLegend(layers) {
    this.legend.replaceChildren(...layers.map(layer => {
      const box = make("input", {type: "checkbox", checked: layer.shown, on: {change: () => { layer.shown = box.checked; this.viewer.recolour(); }}});
      const swatch = make("i", {className: "swatch"});
      layer.swatch = swatch;
      return make("label", {}, box, swatch, make("span", {textContent: layer.name}));
    }));
  }

  showScale(column, low, high) {
    const names = column.kind === "names", bar = barOf(column);
    const rgb = k => `rgb(${bar[4 * k]},${bar[4 * k + 1]},${bar[4 * k + 2]})`;
    this.scale.replaceChildren(make("div", {className: "name", textContent: column.label + (column.unit ? `, ${column.unit}` : "")}));
    this.scale.setAttribute("aria-label", names ? `${column.label}: ${column.names.join(", ")}` : `colours of ${column.label} from ${low} to ${high} ${column.unit}`);
    Object.assign(this.scale.dataset, {column: column.name, low, high, unit: column.unit});
    if (names) {
      this.scale.append(...column.names.slice(0, 12).map((name, k) => {
        const swatch = make("i", {className: "swatch"});
        swatch.style.background = rgb(k);
        return make("div", {className: "row"}, swatch, make("span", {textContent: name}));
      }));
      if (column.names.length > 12) this.scale.append(make("div", {textContent: `and ${column.names.length - 12} more`}));
      return;
    }
    const strip = make("div", {className: "strip"}), ticks = make("div", {className: "ticks"});
    strip.style.background = `linear-gradient(to top, ${[...Array(33).keys()].map(k => rgb(Math.min(255, 8 * k))).join(",")})`;
    const step = roundStep((high - low) / 5 || 1), decimals = decimalsOf(step);
    for (let v = Math.ceil(low / step - 1e-9) * step; v <= high + 1e-9 * step; v += step) {
      const tick = make("span", {textContent: figure(v, decimals)});
      tick.style.bottom = `${(100 * (v - low)) / (high - low || 1)}%`;
      ticks.append(tick);
    }
    this.scale.append(make("div", {className: "both"}, strip, ticks));
    this.limits.forEach((input, k) => { input.value = +[low, high][k].toPrecision(6); });
  }

  // Values of one point, or of two and their difference.
  showPicked(rows) {
    const {scene} = this.viewer;
    if (!rows.length) {
      const what = scene.points ? "Click a point to read its values. " : "";
      this.reading.replaceChildren(make("div", {className: "about", textContent: `${what}Drag, or one finger, turns; shift + drag, or two fingers, moves; wheel, or pinch, zooms once it was clicked; ? lists the keys.`}));
      return;
    }
    const places = rows.map(row => ["x", "y", "z"].map((_, k) => scene.xyz[3 * row + k] + scene.centre[k]));
    const lines = ["x", "y", "z"].map((name, k) => [`${name}, mm`, ...places.map(p => figure(p[k], scene.decimals)),
      ...(rows.length > 1 ? [figure(scene.xyz[3 * rows[1] + k] - scene.xyz[3 * rows[0] + k], scene.decimals)] : [])]);
    for (const column of scene.columns) {
      if (["x", "y", "z"].includes(column.name)) continue;
      const values = rows.map(row => column.values[row]);
      const gap = rows.length > 1 ? [column.kind === "names" ? "" : figure(values[1] - values[0], column.decimals)] : [];
      lines.push([column.label + (column.unit ? `, ${column.unit}` : ""), ...values.map(value => named(column, value)), ...gap]);
    }
    const head = rows.length > 1 ? ["", "A", "B", "B - A"] : ["", `point ${(scene.numbers ? scene.numbers(rows[0]) : rows[0] + 1).toLocaleString("en")}`];
    this.reading.replaceChildren();
    if (rows.length > 1) this.reading.append(make("p", {className: "distance", textContent: `Distance ${figure(this.viewer.distance, scene.decimals)} mm`}));
    this.reading.append(make("table", {className: rows.length > 1 ? "pair" : ""}, make("thead", {}, make("tr", {}, ...head.map(textContent => make("th", {textContent})))),
      make("tbody", {}, ...lines.map(cells => make("tr", {}, ...cells.map((textContent, k) => make(k ? "td" : "th", {textContent})))))));
  }

  tell(words) {
    this.hint.textContent = words;
    this.hint.hidden = false;
    clearTimeout(this.telling);
    this.telling = setTimeout(() => { this.hint.hidden = true; }, 2600);
  }
}
