"use strict";
(() => {
  const root = document.documentElement;
  const data = JSON.parse(document.getElementById("data").textContent);
  const shades = { turning: "rgba(230,159,0,.22)", accelerating: "rgba(86,180,233,.28)", drifting: "rgba(120,120,120,.18)" };
  const shade = (label) => label.includes("turning") ? (label.includes("acc") ? "rgba(204,121,167,.25)" : shades.turning)
    : label.includes("accelerating") ? shades.accelerating : shades.drifting;
  document.querySelectorAll(".shade").forEach((e) => { e.style.background = shade(e.dataset.kind); });

  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const times = (t) => Array.from(new Int32Array(bytes(t.data)), (k) => t.start + t.step * k);
  const values = (s, key, log) => Array.from(new Int16Array(bytes(s[key])), (k) => {
    if (k === -32768) return null;
    const v = s.offset + s.step * k;
    return log ? 10 ** v : v;
  });
  const short = (v) => v === null || v === undefined ? "–" : Number(v.toPrecision(4)).toString().replace("-", "−");

  // Powers of ten; where they are few, also numbers between them.
  const decades = (u, axis, min, max) => {
    const span = Math.log10(max / min);
    const steps = span > 2.5 ? [1] : span > 1 ? [1, 2, 5] : [1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 9];
    const found = [];
    for (let k = Math.floor(Math.log10(min)); k <= Math.ceil(Math.log10(max)); k++) {
      for (const step of steps) {
        const v = Number(`${step}e${k}`);
        if (v >= min * 0.999 && v <= max * 1.001) found.push(v);
      }
    }
    return found;
  };

  let language = "en";
  const plots = [];
  const setLanguage = (to) => {
    language = to;
    root.dataset.lang = to;
    root.lang = to === "zh" ? "zh-Hans" : "en";
    document.querySelectorAll("[data-zh]").forEach((e) => { e.setAttribute("aria-label", to === "zh" ? e.dataset.zh : e.dataset.en); });
    plots.forEach((u) => u.redraw(false, true));
  };
  document.getElementById("language").addEventListener("click", () => setLanguage(language === "en" ? "zh" : "en"));
  setLanguage((navigator.language || "en").startsWith("zh") ? "zh" : "en");

  const together = uPlot.sync("time");
  const font = "12px system-ui, 'Noto Sans', 'Noto Sans CJK SC', sans-serif";
  const label = (en, zh) => () => (language === "zh" ? zh : en);
  const make = (plot) => {
    const place = document.getElementById(plot.key);
    const readout = place.parentNode.querySelector(".readout");
    const columns = [times(plot.time)];
    const series = [{}];
    const bands = [];
    for (const s of plot.series) {
      const low = s.lows = values(s, "low", plot.log);
      if (s.high !== undefined) s.highs = values(s, "high", plot.log);
      const style = { stroke: s.colour, width: 1.3, dash: s.dash, points: { show: false }, spanGaps: false };
      if (s.high === undefined) {
        columns.push(low);
        series.push(style);
      } else {
        columns.push(low, s.highs);
        bands.push({ series: [series.length + 1, series.length], fill: s.colour + "33" });
        series.push({ ...style, dash: [], width: 0.8 }, { ...style, dash: [], width: 0.8 });
      }
    }
    const zero = (u, limit) => { const y = u.valToPos(limit, "y", true); u.ctx.moveTo(u.bbox.left, y); u.ctx.lineTo(u.bbox.left + u.bbox.width, y); };
    const width = () => Math.max(place.clientWidth, 220);
    const u = new uPlot({
      width: width(), height: plot.height, legend: { show: false }, bands, series,
      cursor: { sync: { key: "time", scales: ["x", null] }, drag: { x: true, y: false } },
      scales: { x: { time: false }, y: plot.log ? { distr: 3, range: (u, min, max) => [min / 1.3, max * 1.3] } : plot.limit === null ? {} : { range: [-plot.limit * 1.08, plot.limit * 1.08] } },
      axes: [{ size: 34, space: 60, label: label("time, s", "时间，s"), labelSize: 20, labelFont: font, font }, { size: 72, label: label(plot.label, plot.label_zh), labelSize: 20, labelFont: font, font, values: (_, ticks) => ticks.map(short), ...(plot.log ? { splits: decades, filter: (_, ticks) => ticks } : {}) }],
      hooks: {
        drawClear: [(u) => {
          for (const [from, to, label] of plot.shade) {
            const a = Math.max(u.valToPos(from, "x", true), u.bbox.left);
            const b = Math.min(u.valToPos(to, "x", true), u.bbox.left + u.bbox.width);
            if (b > a) { u.ctx.fillStyle = shade(label); u.ctx.fillRect(a, u.bbox.top, b - a, u.bbox.height); }
          }
        }],
        draw: [(u) => {
          const c = u.ctx;
          c.save();
          c.strokeStyle = "#555"; c.lineWidth = 1;
          if (plot.band !== null) { c.setLineDash([6, 4]); c.beginPath(); zero(u, plot.band); zero(u, -plot.band); c.stroke(); c.setLineDash([]); }
          plot.series.forEach((s) => {
            const low = s.lows, high = s.highs || low;
            c.fillStyle = s.colour;
            for (const k of s.outside) {
              const x = u.valToPos(columns[0][k], "x", true);
              if (x < u.bbox.left || x > u.bbox.left + u.bbox.width) continue;
              for (const sign of [1, -1]) {
                if ((sign > 0 ? high[k] : -low[k]) < plot.limit * 0.999) continue;
                const y = sign > 0 ? u.bbox.top + 2 : u.bbox.top + u.bbox.height - 2;
                c.beginPath(); c.moveTo(x, y); c.lineTo(x - 5, y + sign * 9); c.lineTo(x + 5, y + sign * 9); c.fill();
              }
            }
          });
          c.restore();
        }],
        setCursor: [(u) => {
          const k = u.cursor.idx;
          if (k === null || k === undefined) { readout.textContent = "\u00a0"; return; }
          let at = 1;
          const shown = plot.series.map((s) => {
            const low = columns[at][k], high = s.high === undefined ? low : columns[at + 1][k];
            at += s.high === undefined ? 1 : 2;
            const range = short(low) === short(high) ? short(low) : `${short(low)} … ${short(high)}`;
            return `${language === "zh" ? s.name_zh : s.name} ${range}`;
          });
          readout.textContent = `${short(columns[0][k])} s: ${shown.join(", ")} ${plot.unit}`;
        }],
      },
    }, columns, place);
    together.sub(u);
    u.root.setAttribute("aria-hidden", "true");
    let index = 0;
    place.addEventListener("keydown", (e) => {
      const x = u.scales.x, n = columns[0].length, all = [columns[0][0], columns[0][n - 1]];
      const half = (x.max - x.min) / 2, here = columns[0][index];
      if (e.key === "ArrowRight") index = Math.min(index + (e.shiftKey ? 20 : 1), n - 1);
      else if (e.key === "ArrowLeft") index = Math.max(index - (e.shiftKey ? 20 : 1), 0);
      else if (e.key === "Home") index = 0;
      else if (e.key === "End") index = n - 1;
      else if (e.key === "+" || e.key === "=") u.setScale("x", { min: Math.max(here - half / 2, all[0]), max: Math.min(here + half / 2, all[1]) });
      else if (e.key === "-") u.setScale("x", { min: Math.max(x.min - half, all[0]), max: Math.min(x.max + half, all[1]) });
      else if (e.key === "0" || e.key === "Escape") u.setScale("x", { min: all[0], max: all[1] });
      else return;
      e.preventDefault();
      u.setCursor({ left: u.valToPos(columns[0][index], "x"), top: 60 });
    });
    plots.push(u);
    const resize = () => u.setSize({ width: width(), height: plot.height });
    window.addEventListener("resize", resize);
    window.addEventListener("beforeprint", resize);
  };
  data.plots.forEach(make);
  root.dataset.drawn = String(plots.length);
})();
