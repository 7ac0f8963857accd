"use strict";
// Zooming a strip chart shows the values as measured, and the stretch in view on the map; rows of tables and marks on the map lead to their place.
(function () {
  const plan = document.getElementById("plan");
  const marker = plan && plan.figure && plan.figure.marker;
  const BESIDE = 0.1; // km on both sides of a place that is led to
  const WIDE = 0.6; // share of the whole above which the drawn points are enough

  // Packed values: base64, inflated, differences of 16-bit whole numbers summed up again.
  const unpack = async function (packed) {
    const bytes = Uint8Array.from(atob(packed.data), function (c) { return c.charCodeAt(0); });
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    const steps = new Int16Array(await new Response(stream).arrayBuffer());
    const whole = new Int16Array(steps.length);
    let sum = 0;
    for (let i = 0; i < steps.length; i++) { sum += steps[i]; whole[i] = sum; }
    return whole;
  };
  const between = function (from, to, value) {
    let low = 0, high = from.length - 1;
    while (high - low > 1) { const middle = (low + high) >> 1; if (from[middle] <= value) low = middle; else high = middle; }
    return to[low] + (value - from[low]) * (to[high] - to[low]) / ((from[high] - from[low]) || 1);
  };
  // At most `most` points of a stretch, with the least and the greatest of each part.
  const shown = function (fine, whole, scale, a, b, most) {
    const x = [], y = [];
    const part = Math.max(1, Math.ceil(2 * (b - a + 1) / most));
    const put = function (i) {
      const at = between(fine.nodes[0], fine.nodes[1], fine.first + i * fine.step);
      // kilometres are missing here: the curve breaks
      if (x.length && Math.abs(at - x[x.length - 1]) > 0.003 * (part + 1) * fine.step + 0.0005) { x.push(at); y.push(null); }
      x.push(at);
      y.push(whole[i] === -32768 ? null : whole[i] * scale);
    };
    for (let i = a; i <= b; i += part) {
      if (part === 1) { put(i); continue; }
      let low = -1, high = -1, gap = -1;
      for (let k = i; k < Math.min(i + part, b + 1); k++) {
        if (whole[k] === -32768) { gap = k; continue; }
        if (low < 0 || whole[k] < whole[low]) low = k;
        if (high < 0 || whole[k] > whole[high]) high = k;
      }
      for (const k of [low, high, gap].filter(function (k, j, all) { return k >= 0 && all.indexOf(k) === j; }).sort(function (p, q) { return p - q; })) put(k);
    }
    return [x, y];
  };

  const link = function (place) {
    const figure = place.figure, fine = figure.fine;
    const indices = fine ? Object.keys(fine.traces).map(Number) : [];
    const coarse = indices.map(function (i) { return [figure.data[i].x, figure.data[i].y]; });
    let wholes = null, turn = 0, detailed = false;
    const view = function (range) {
      const along = marker && marker.places && marker.places[figure.id];
      if (!along || marker.view === undefined) return;
      const x = [], y = [];
      if (range) {
        for (let k = 0; k < along.time.length; k++) if (along.time[k] >= range[0] && along.time[k] <= range[1]) { x.push(along.x[k]); y.push(along.y[k]); }
      }
      Plotly.restyle(plan, { x: [x.length ? x : [null]], y: [y.length ? y : [null]] }, [marker.view]);
    };
    place.on("plotly_relayout", async function (event) {
      let range = event["xaxis.range"] || (event["xaxis.range[0]"] !== undefined ? [event["xaxis.range[0]"], event["xaxis.range[1]"]] : null);
      if (!range && !event["xaxis.autorange"]) return;
      const mine = ++turn;
      if (range) range = [Math.min(Number(range[0]), Number(range[1])), Math.max(Number(range[0]), Number(range[1]))];
      view(range);
      if (!fine) return;
      const whole = fine.nodes[1];
      if (!range || range[1] - range[0] > WIDE * Math.abs(whole[whole.length - 1] - whole[0])) {
        if (detailed) { detailed = false; Plotly.restyle(place, { x: coarse.map(function (c) { return c[0]; }), y: coarse.map(function (c) { return c[1]; }) }, indices); }
        return;
      }
      if (!wholes) wholes = await Promise.all(indices.map(function (i) { return unpack(fine.traces[i]); }));
      if (mine !== turn) return;
      const edge = 0.05 * (range[1] - range[0]);
      const index = function (x) { return Math.round((between(fine.nodes[1], fine.nodes[0], x) - fine.first) / fine.step); };
      const a = Math.max(0, index(range[0] - edge)), b = Math.min(fine.count - 1, index(range[1] + edge));
      const curves = indices.map(function (i, k) { return shown(fine, wholes[k], fine.traces[i].scale, a, b, 6000); });
      detailed = true;
      Plotly.restyle(place, { x: curves.map(function (c) { return c[0]; }), y: curves.map(function (c) { return c[1]; }) }, indices);
    });
  };
  const go = function (id, x) {
    const place = document.getElementById(id);
    if (!place || !place.figure) return;
    Plotly.relayout(place, { "xaxis.range": [x - BESIDE, x + BESIDE] });
    place.scrollIntoView({ behavior: "smooth", block: "start" });
  };
  for (const place of document.querySelectorAll(".plot")) if (place.figure && place.figure.moves) link(place);
  for (const row of document.querySelectorAll("tr.go")) {
    row.addEventListener("click", function () { go(row.dataset.figure, Number(row.dataset.x)); });
  }
  if (plan && plan.on) {
    plan.on("plotly_click", function (event) {
      const to = event.points[0] && event.points[0].customdata;
      if (to) go(to[0], to[1]);
    });
  }
})();
