"use strict";
(function () {
  const all = (selector, within) => Array.from((within || document).querySelectorAll(selector));
  document.documentElement.classList.add("live");

  // Colours: as the system has them, or one of the two.
  const themes = { "": "as the system", light: "light", dark: "dark" };
  const button = document.getElementById("theme");
  const remembered = (value) => {
    try {
      if (value === undefined) return localStorage.getItem("nnss-theme") || "";
      localStorage.setItem("nnss-theme", value);
    } catch (_) { /* a file may have no storage */ }
    return "";
  };
  const paint = (theme) => {
    if (theme) document.documentElement.dataset.theme = theme;
    else delete document.documentElement.dataset.theme;
    button.textContent = "Colours: " + themes[theme];
  };
  let theme = themes[remembered()] ? remembered() : "";
  paint(theme);
  button.addEventListener("click", () => {
    const names = Object.keys(themes);
    theme = names[(names.indexOf(theme) + 1) % names.length];
    remembered(theme);
    paint(theme);
  });

  // Tables: a button in the head of each column sorts by it, numbers by value, ∞ last and – after it.
  const valueOf = (cell) => {
    if (cell.dataset.v !== undefined) return Number(cell.dataset.v);
    const text = cell.textContent.trim();
    if (text.startsWith("∞")) return Infinity;
    const found = text.match(/^[+\-−]?\d[\d.]*(e[+-]?\d+)?/);
    return found ? Number(found[0].replace("−", "-")) : text;
  };
  const order = (a, b) => {
    const numbers = (typeof a === "number") - (typeof b === "number");
    if (numbers) return -numbers;
    if (typeof a === "number") return a < b ? -1 : a > b ? 1 : 0;
    return a.localeCompare(b);
  };
  for (const table of all("table.sortable")) {
    const heads = all("thead th", table);
    const body = table.tBodies[0];
    heads.forEach((head, column) => {
      const press = document.createElement("button");
      press.type = "button";
      press.append(...head.childNodes);
      head.append(press);
      press.addEventListener("click", () => {
        const down = head.getAttribute("aria-sort") === "ascending";
        heads.forEach((other) => other.removeAttribute("aria-sort"));
        head.setAttribute("aria-sort", down ? "descending" : "ascending");
        const rows = Array.from(body.rows).map((row) => [valueOf(row.cells[column]), row]);
        rows.sort((a, b) => (down ? order(b[0], a[0]) : order(a[0], b[0])));
        body.append(...rows.map((pair) => pair[1]));
      });
    });
  }

  // Filters: what is of a method, order or split that is not wanted is not shown in the section.
  for (const section of all("section.record")) {
    const form = section.querySelector("form.filters");
    const boxes = all("input", form);
    const apply = () => {
      const wanted = { method: new Set(), order: new Set(), split: new Set() };
      boxes.forEach((box) => { if (box.checked) wanted[box.name].add(box.value); });
      for (const element of all("[data-method], [data-order], [data-split]", section)) {
        const off = Object.keys(wanted).some(
          (name) => element.dataset[name] !== undefined && !wanted[name].has(element.dataset[name])
        );
        element.classList.toggle("off", off);
      }
      const rows = all("table.errors tbody tr", section);
      const shown = rows.filter((row) => !row.classList.contains("off")).length;
      const count = section.querySelector(".count");
      if (count) count.textContent = shown + " of " + rows.length + " rows are shown.";
    };
    form.addEventListener("change", apply);
    form.addEventListener("submit", (event) => event.preventDefault());
    apply();
  }

  // Signals: zoom by dragging, buttons or keys; a cursor with the values at its time.
  const digits = (value) => (value === null ? "–" : String(Number(value.toPrecision(4))));
  const round = (low, high, count) => {
    const raw = (high - low) / count;
    const power = Math.pow(10, Math.floor(Math.log10(raw)));
    const step = [1, 2, 2.5, 5, 10].map((n) => n * power).find((n) => n >= raw * 0.999);
    const ticks = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) ticks.push(Number((k * step).toPrecision(12)));
    return ticks;
  };
  const labels = (box, ticks, side, place) => {
    box.replaceChildren(...ticks.map((tick) => {
      const label = document.createElement("span");
      label.textContent = String(Number(tick.toPrecision(6)));
      label.style[side] = (100 * place(tick)).toFixed(2) + "%";
      return label;
    }));
  };
  const svg = (d, name) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", "path");
    made.setAttribute("d", d);
    made.setAttribute("class", name);
    return made;
  };

  class Trace {
    constructor(figure) {
      this.figure = figure;
      const data = JSON.parse(figure.querySelector("script").textContent);
      this.K = data.samples;
      this.step = data.step;
      this.unit = data.unit;
      this.starts = data.starts;
      this.panels = all(".panel", figure).map((panel, i) => ({
        frame: panel.querySelector(".frame"),
        plot: panel.querySelector(".plot"),
        ys: panel.querySelector(".ys"),
        title: panel.querySelector(".ylabel").textContent,
        lines: all(".plot > path", panel),
        series: data.panels[i].map((one) => {
          const unit = (one.high - one.low) / data.steps;
          return { name: one.name, held: one.held, values: one.values.map((q) => (q === null ? null : one.low + q * unit)) };
        }),
      }));
      this.xs = figure.querySelector(".xs");
      this.readout = figure.querySelector(".readout");
      this.bins = data.bins;
      this.at = null;
      for (const panel of this.panels) {
        panel.cursor = document.createElement("div");
        panel.cursor.className = "cursor off";
        panel.brush = document.createElement("div");
        panel.brush.className = "brush off";
        panel.frame.append(panel.cursor, panel.brush);
        this.listen(panel);
      }
      // one stop for the keyboard in the figure: the first picture
      const stop = this.panels[0].frame;
      stop.tabIndex = 0;
      stop.setAttribute("role", "group");
      stop.setAttribute("aria-label", figure.querySelector("figcaption").textContent + ": arrow keys read values, + and − zoom, 0 shows all");
      stop.addEventListener("keydown", (event) => this.key(event));
      stop.addEventListener("blur", () => this.point(null));
      const does = {
        in: () => this.zoom(0.5), out: () => this.zoom(2), back: () => this.shift(-0.5), on: () => this.shift(0.5),
        all: () => this.show(0, this.K - 1),
      };
      all("[data-do]", figure).forEach((press) => press.addEventListener("click", does[press.dataset.do]));
      this.rest();
      this.show(0, this.K - 1);
    }

    // sample → place among the kept values, and back
    index(sample) { return this.bins ? (sample / this.K) * this.bins * 2 : sample; }
    sample(index) { return this.bins ? ((Math.floor(index / 2) + 0.5) / this.bins) * this.K - 0.5 : index; }

    show(from, to) {
      const least = Math.min(8, this.K - 1);
      const width = Math.min(Math.max(to - from, least), this.K - 1) || 1;
      this.from = Math.min(Math.max(from, 0), this.K - 1 - width);
      if (this.from < 0) this.from = 0;
      this.to = this.from + width;
      for (const panel of this.panels) this.draw(panel);
      const place = (time) => (time / this.step - this.from) / (this.to - this.from);
      const count = Math.max(2, Math.min(8, Math.floor(this.panels[0].frame.clientWidth / 80)));
      labels(this.xs, round(this.from * this.step, this.to * this.step, count), "left", place);
      if (this.at !== null) this.point(this.at);
    }

    draw(panel) {
      const first = Math.max(0, Math.floor(this.index(this.from)) - 1);
      const parts = panel.series.map((one) => one.values.slice(first, Math.ceil(this.index(this.to)) + 2));
      let low = Infinity;
      let high = -Infinity;
      parts.forEach((values, i) => {
        if (panel.lines[i].classList.contains("off")) return;
        for (const value of values) if (value !== null) { if (value < low) low = value; if (value > high) high = value; }
      });
      if (low > high) return;
      const margin = 0.04 * (high - low || Math.abs(high) || 1);
      low -= margin;
      high += margin;
      const x = (sample) => Math.round((1000 * 10 * (sample - this.from)) / (this.to - this.from)) / 10;
      const y = (value) => Math.round(10000 * (1 - (value - low) / (high - low))) / 10;
      panel.lines.forEach((line, i) => {
        const held = panel.series[i].held;
        let d = "";
        let broken = true;
        let before = null;
        const put = (at, value) => { d += (broken ? "M" : "L") + at + " " + y(value); broken = false; };
        const values = parts[i];
        const dense = values.length > 4000;
        let column = null;
        values.forEach((value, j) => {
          if (value === null) { broken = true; return; }
          const at = x(this.sample(first + j));
          if (dense) { // smallest and largest of each half step
            const place = Math.round(at * 2);
            if (column && column.place === place) { column.low = Math.min(column.low, value); column.high = Math.max(column.high, value); return; }
            if (column) { put(column.place / 2, column.low); put(column.place / 2, column.high); }
            column = { place, low: value, high: value };
            return;
          }
          if (held && before !== null && !broken) put(at, before);
          put(at, value);
          before = value;
        });
        if (column) { put(column.place / 2, column.low); put(column.place / 2, column.high); }
        line.setAttribute("d", d);
      });
      const ticks = round(low, high, panel.frame.clientHeight > 100 ? 4 : 3);
      const place = (value) => (value - low) / (high - low);
      labels(panel.ys, ticks, "bottom", place);
      const marks = ticks.map((value) => svg("M0 " + y(value) + "H1000", "grid"));
      for (const start of this.starts) if (start > this.from && start < this.to) marks.push(svg("M" + x(start) + " 0V1000", "break"));
      panel.plot.querySelector(".marks").replaceChildren(...marks);
    }

    zoom(factor) {
      const middle = this.at === null ? (this.from + this.to) / 2 : this.at;
      const half = ((this.to - this.from) * factor) / 2;
      this.show(middle - half, middle + half);
    }

    shift(share) {
      const by = share * (this.to - this.from);
      this.show(this.from + by, this.to + by);
    }

    key(event) {
      const stride = Math.max(1, Math.round((this.to - this.from) / (event.shiftKey ? 20 : 200)));
      const at = this.at === null ? Math.round((this.from + this.to) / 2) : this.at;
      const does = {
        ArrowLeft: () => this.move(at - stride), ArrowRight: () => this.move(at + stride),
        Home: () => this.move(Math.ceil(this.from)), End: () => this.move(Math.floor(this.to)),
        "+": () => this.zoom(0.5), "=": () => this.zoom(0.5), "-": () => this.zoom(2), 0: () => this.show(0, this.K - 1),
        Escape: () => this.point(null),
      };
      if (does[event.key] && !event.ctrlKey && !event.metaKey && !event.altKey) {
        event.preventDefault();
        does[event.key]();
      }
    }

    move(sample) {
      const at = Math.min(Math.max(sample, 0), this.K - 1);
      if (at < this.from) this.show(at, at + this.to - this.from);
      if (at > this.to) this.show(at - (this.to - this.from), at);
      this.point(at);
    }

    listen(panel) {
      const place = (event) => {
        const box = panel.plot.getBoundingClientRect();
        return this.from + Math.min(Math.max((event.clientX - box.left) / box.width, 0), 1) * (this.to - this.from);
      };
      let begun = null;
      panel.plot.addEventListener("pointerdown", (event) => {
        if (event.button) return;
        begun = place(event);
        panel.plot.setPointerCapture(event.pointerId);
      });
      panel.plot.addEventListener("pointermove", (event) => {
        const here = place(event);
        this.point(Math.round(here));
        if (begun !== null) this.brush(Math.min(begun, here), Math.max(begun, here));
      });
      const end = (event) => {
        if (begun === null) return;
        const here = place(event);
        const from = Math.min(begun, here);
        const to = Math.max(begun, here);
        begun = null;
        this.brush(null);
        if (event.type === "pointerup" && to - from > 0.015 * (this.to - this.from)) this.show(from, to);
      };
      panel.plot.addEventListener("pointerup", end);
      panel.plot.addEventListener("pointercancel", end);
      panel.plot.addEventListener("pointerleave", () => { if (begun === null) this.point(null); });
      panel.plot.addEventListener("dblclick", () => this.show(0, this.K - 1));
    }

    share(sample) { return (100 * (sample - this.from)) / (this.to - this.from); }

    brush(from, to) {
      for (const panel of this.panels) {
        panel.brush.classList.toggle("off", from === null);
        if (from === null) continue;
        panel.brush.style.left = this.share(from) + "%";
        panel.brush.style.width = this.share(to) - this.share(from) + "%";
      }
    }

    rest() { this.readout.textContent = "The values under the cursor stand here."; }

    point(sample) {
      this.at = sample;
      for (const panel of this.panels) panel.cursor.classList.toggle("off", sample === null);
      if (sample === null) { this.rest(); return; }
      const parts = ["time " + digits(sample * this.step) + " " + this.unit];
      for (const panel of this.panels) {
        panel.cursor.style.left = this.share(sample) + "%";
        const values = panel.series.map((one, i) => {
          if (panel.lines[i].classList.contains("off")) return null;
          if (!this.bins) return one.name + " " + digits(one.values[sample]);
          const at = 2 * Math.min(Math.floor((sample * this.bins) / this.K), this.bins - 1);
          return one.name + " " + digits(one.values[at]) + " to " + digits(one.values[at + 1]);
        });
        parts.push(panel.title + ": " + values.filter((text) => text !== null).join("; "));
      }
      this.readout.replaceChildren(...parts.map((text) => {
        const part = document.createElement("span");
        part.textContent = text;
        return part;
      }));
    }
  }
  // A figure comes to life when it is about to be seen: until then it is as it was drawn.
  const traces = [];
  const near = new IntersectionObserver((seen) => seen.forEach((one) => {
    if (!one.isIntersecting) return;
    near.unobserve(one.target);
    traces.push(new Trace(one.target));
  }), { rootMargin: "600px" });
  all("figure.trace").forEach((figure) => near.observe(figure));
  document.addEventListener("change", () => traces.forEach((one) => one.show(one.from, one.to)));

  // Only what can be scrolled is a stop for the keyboard.
  const stops = () => all(".scroll").forEach((one) => { one.tabIndex = one.scrollWidth > one.clientWidth ? 0 : -1; });
  window.addEventListener("resize", stops);
  document.addEventListener("toggle", stops, true);
  requestIdleCallback(stops);

  // What is folded is printed too, and folded again afterwards.
  let unfolded = [];
  window.addEventListener("beforeprint", () => {
    unfolded = all("details:not([open])");
    unfolded.forEach((one) => { one.open = true; });
  });
  window.addEventListener("afterprint", () => unfolded.forEach((one) => { one.open = false; }));
})();
