// SPDX-License-Identifier: Apache-2.0
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const kinds = { f4: Float32Array, i4: Int32Array, u1: Uint8Array };
  const integers = new Set(["ping", "beacon"]);
  const bytes = new Set(["decision", "arrival", "explanation", "verdict", "n", "consistent"]);

  const words = new Set(["method", "reference", "name", "unit"]);

  const unpack = (text, kind) => {
    const raw = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    return Array.from(new kinds[kind](raw.buffer));
  };
  const columns = (packed) => Object.fromEntries(Object.entries(packed)
    .filter(([name, value]) => typeof value === "string" && !words.has(name))
    .map(([name, value]) => [name, unpack(value, integers.has(name) ? "i4" : bytes.has(name) ? "u1" : "f4")]));

  const utc = (t) => new Date(data.start_ms + 1e3 * t).toISOString().replace("T", " ").slice(0, 19);
  const times = (t) => t.map((s) => new Date(data.start_ms + 1e3 * s).toISOString().slice(0, 23).replace("T", " "));
  const clock = (t) => {
    const s = Math.round(t);
    const two = (n) => String(n).padStart(2, "0");
    return `${Math.floor(s / 3600)}:${two(Math.floor(s / 60) % 60)}:${two(s % 60)}`;
  };
  const quantile = (values, q) => { const v = values.filter(Number.isFinite).sort((a, b) => a - b); return v.length ? v[Math.floor(q * (v.length - 1))] : NaN; };
  const logarithmic = { type: "log", dtick: 1, exponentformat: "none", separatethousands: true };
  const narrow = () => document.body.clientWidth < 640;
  const plain = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
  const hover = (c) => c.t.map((t, k) =>
    `${utc(t)} UTC<br>dive ${clock(t)}<br>depth ${c.depth[k].toFixed(1)} m<br>ping ${c.ping[k]}`);

  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const axis = () => ({ gridcolor: css("--line"), linecolor: css("--line"), zerolinecolor: css("--line"), tickcolor: css("--line") });
  // Of the height on a screen: what has several axes one below the other needs it all.
  const heightOnPaper = { plan: 0.95, profile: 1, estimates: 0.78, innovations: 0.66 };
  let onPaper = false;
  // Buttons are named one by one: the library's own choice has one that uploads the chart.
  const buttons = [["toImage", "zoom2d", "pan2d", "resetScale2d"]];
  const draw = (id, traces, layout) => {
    const place = document.getElementById(id);
    if (!traces.length) { Plotly.purge(place); place.style.height = "0"; return; }
    const axes = Object.fromEntries(Object.keys(layout).filter((k) => /^[xy]axis/.test(k)).map((k) => [k, { ...axis(), ...(k[0] === "y" ? { automargin: true } : {}), ...layout[k] }]));
    const full = {
      legend: { orientation: "h", y: 1.0, yanchor: "bottom", font: { size: narrow() ? 11 : 12.5 } }, hovermode: "closest",
      font: { family: getComputedStyle(document.body).fontFamily, size: 12.5, color: css("--ink") }, dragmode: matchMedia("(pointer: coarse)").matches ? false : "zoom",
      paper_bgcolor: css("--paper"), plot_bgcolor: css("--paper"),
      hoverlabel: { bgcolor: css("--card"), bordercolor: css("--line"), font: { color: css("--ink") }, align: "left" }, uirevision: id, ...layout, ...axes,
      margin: { l: narrow() ? 46 : 64, r: narrow() ? 8 : 16, t: 34, b: 44, ...layout.margin },
      ...(onPaper ? { width: 680, height: (heightOnPaper[id] || 0.72) * layout.height } : {}), autosize: !onPaper,
    };
    Plotly.react(place, traces, full, { responsive: true, displaylogo: false, modeBarButtons: buttons, plotlyServerURL: "", displayModeBar: narrow() ? false : "hover" });
  };

  // Axes of one of n plots that lie one below the other; the names by which its traces go to them.
  const addAxes = (layout, row, n, gap, x, y) => {
    const id = row ? row + 1 : "";
    layout[`yaxis${id}`] = { domain: [1 - (row + 1) / n + gap, 1 - row / n], ...y };
    layout[`xaxis${id}`] = { anchor: `y${id}`, ...(row ? { matches: "x" } : {}), showticklabels: row === n - 1, ...x };
    return { xaxis: `x${id}`, yaxis: `y${id}` };
  };

  // --- plan -------------------------------------------------------------------------------------
  const plan = data.plan, shows = (method) => method === plan.best;
  const [west, east, south, north] = plan.frame;
  const line = (name, c, look, more) => ({ x: c.x, y: c.y, text: hover(c), name, type: "scatter", mode: "lines", line: look,
    hovertemplate: `<b>${name}</b><br>%{x:.1f} E, %{y:.1f} N<br>%{text}<extra></extra>`, ...more });
  const fixTraces = () => {
    const fixes = columns(data.fixes);
    return [["fix", 1, data.colours.fix], ["fix, inconsistent", 0, data.colours.poor_fix]].flatMap(([name, wanted, colour]) => {
      const rows = fixes.t.map((_, k) => k).filter((k) => fixes.consistent[k] === wanted);
      const pick = (column) => rows.map((k) => column[k]);
      const c = { t: pick(fixes.t), depth: pick(fixes.depth), ping: pick(fixes.ping) }, n = pick(fixes.n), rms = pick(fixes.rms_ms);
      return rows.length ? [{ x: pick(fixes.x), y: pick(fixes.y), name, type: "scatter", mode: "markers", visible: wanted ? true : "legendonly",
        marker: { color: colour, size: 4, symbol: wanted ? "circle" : "x-thin", line: { color: colour, width: wanted ? 0 : 1 } },
        text: hover(c).map((h, j) => `${h}<br>${n[j]} replies, rms ${rms[j].toFixed(2)} ms`),
        hovertemplate: `<b>${name}</b><br>%{x:.1f} E, %{y:.1f} N<br>%{text}<extra></extra>` }] : [];
    });
  };
  const positionTraces = () => {
    const c = columns(data.positions);
    return [["position", true, data.colours.position], ["position, not accepted", false, data.colours.refused_position]].flatMap(([name, wanted, colour]) => {
      const rows = c.t.map((_, k) => k).filter((k) => (c.decision[k] === 0) === wanted);
      const pick = (column) => rows.map((k) => column[k]);
      const own = { t: pick(c.t), depth: pick(c.depth), ping: pick(c.ping) };
      return rows.length ? [{ x: pick(c.x), y: pick(c.y), name, type: "scatter", mode: "markers",
        marker: { color: colour, size: wanted ? 5 : 6, symbol: wanted ? "diamond" : "x-thin", line: { color: colour, width: wanted ? 0 : 1.2 } },
        text: hover(own).map((h, j) => `${h}<br>σ ${c.sigma_m[rows[j]].toFixed(1)} m, ${data.decisions[c.decision[rows[j]]]}`),
        hovertemplate: `<b>${name}</b><br>%{x:.1f} E, %{y:.1f} N<br>%{text}<extra></extra>` }] : [];
    });
  };
  // Labels of the marks that do not lie on one another; the rest stay marks.
  const markTrace = (pixelsPerMetre) => {
    const placed = [], m = plan.marks;
    const labels = m.label.map((label, k) => {
      const at = [m.x[k] * pixelsPerMetre, m.y[k] * pixelsPerMetre];
      if (placed.some((p) => Math.abs(p[0] - at[0]) < 44 && Math.abs(p[1] - at[1]) < 18)) return "";
      placed.push(at);
      return label;
    });
    return { x: m.x, y: m.y, text: labels, customdata: m.label, name: "time, UTC", type: "scatter", mode: "markers+text", textposition: "top right", cliponaxis: true,
      textfont: { size: 10.5, color: css("--ink") }, marker: { symbol: "circle", size: 5, color: css("--paper"), line: { color: css("--ink"), width: 1.2 } },
      hovertemplate: "%{customdata} UTC<extra></extra>" };
  };
  const endTrace = (c) => {
    const last = c.x.length - 1, near = Math.hypot(c.x[0] - c.x[last], c.y[0] - c.y[last]) < 0.06 * (east - west);
    return { x: [c.x[0], c.x[last]], y: [c.y[0], c.y[last]], text: ["<b>start</b>", "<b>end</b>"], name: "start, end", type: "scatter", mode: "markers+text",
      textposition: near ? ["bottom left", "bottom right"] : ["bottom center", "bottom center"], textfont: { size: 12 }, showlegend: false,
      marker: { symbol: ["circle", "square"], size: 10, color: ["#1a7f45", "#c22a2a"], line: { color: css("--paper"), width: 1.5 } }, hovertemplate: "%{text}<extra></extra>" };
  };
  const scaleBar = (x0, x1, y0, y1) => {
    const most = Math.abs(x1 - x0) / 4, decade = 10 ** Math.floor(Math.log10(most));
    const bar = [5, 2, 1].map((k) => k * decade).find((m) => m <= most);
    const x = x0 + 0.04 * (x1 - x0), y = y0 + 0.05 * (y1 - y0), tick = 0.012 * (y1 - y0);
    const ink = { color: css("--ink"), width: 2 };
    const stroke = (a, b, c, d) => ({ type: "line", x0: a, y0: b, x1: c, y1: d, line: ink });
    return {
      shapes: [stroke(x, y, x + bar, y), stroke(x, y - tick, x, y + tick), stroke(x + bar, y - tick, x + bar, y + tick)],
      annotations: [{ x: x + bar / 2, y, yshift: 11, text: `<b>${bar >= 1000 ? `${bar / 1000} km` : `${bar} m`}</b>`, showarrow: false, font: { color: css("--ink"), size: 12 } },
        { xref: "paper", yref: "paper", x: 0.99, y: 0.99, xanchor: "right", yanchor: "top", text: "<b>N ↑</b>", showarrow: false, font: { color: css("--ink"), size: 13 } }],
    };
  };
  // What is looked at: a sheet of another shape shows more about it, and must not change it.
  let frame = plan.frame, scaledFor = null;
  // The scale is that of what is shown, and a zoom is kept when the plan is drawn anew.  To a
  // thousandth: each drawing of the scale may move the axes, which share theirs, by a hair again.
  const follow = (change) => {
    const shown = document.getElementById("plan")._fullLayout;
    if (!shown) return;
    const now = [...shown.xaxis.range, ...shown.yaxis.range];
    if (Object.keys(change).some((name) => /^[xy]axis/.test(name))) frame = now;
    const hair = 1e-3 * Math.abs(now[1] - now[0]);
    if (scaledFor && now.every((end, k) => Math.abs(end - scaledFor[k]) < hair)) return;
    scaledFor = now;
    Plotly.relayout("plan", scaleBar(...now));
  };
  const shade = document.getElementById("plan-colour");
  data.shades.forEach(({ name }, k) => shade.add(new Option(name, k)));
  const shadeTrace = (c, { name, unit, v }) => {
    const values = unpack(v, "f4"), low = quantile(values, 0), high = quantile(values, 0.99);
    return { x: c.x, y: c.y, text: hover(c).map((h, k) => `${name} ${values[k].toFixed(2)} ${unit}<br>${h}`), name, showlegend: false, type: "scatter", mode: "markers",
      marker: { color: values, cmin: low, cmax: high, size: 6, colorscale: data.colours.sequential.map((colour, k, all) => [k / (all.length - 1), colour]),
        colorbar: { orientation: "h", title: { text: `${name} [${unit}]`, side: "bottom", font: { size: 12.5 } }, thickness: 12, x: 0.5, y: 0, yref: "container", yanchor: "bottom", len: narrow() ? 0.9 : 0.5 } },
      hovertemplate: "%{x:.1f} E, %{y:.1f} N<br>%{text}<extra></extra>" };
  };
  const drawPlan = () => {
    const tracks = data.tracks.map((track) => ({ method: track.method, c: columns(track) }));
    const best = tracks.find(({ method }) => shows(method)), traces = [];
    const colour = (method) => data.colours.method[method];
    if (plan.band) {
      const c = columns(plan.band);
      traces.push({ x: c.x, y: c.y, name: "95 % band", type: "scatter", mode: "lines", fill: "toself", line: { width: 0.5, color: colour(plan.best) }, fillcolor: `${colour(plan.best)}55`, hoverinfo: "skip" });
    }
    if (data.reference) traces.push(line("truth", columns(data.reference), { color: data.colours.reference, width: 4 }, {}));
    if (plan.positioned) traces.push(...fixTraces());
    if (plan.positioned && data.positions) traces.push(...positionTraces());
    for (const { method, c } of tracks) if (!shows(method)) traces.push(line(method, c, { color: colour(method), width: 1.6 }, { visible: "legendonly" }));
    const width = document.getElementById("plan").clientWidth - 80, height = narrow() ? 420 : 600;
    if (best) {
      traces.push(line(plan.positioned ? best.method : `${best.method}, from an arbitrary point`, best.c, { color: colour(best.method), width: 2 }, {}));
      if (shade.value) traces.push(shadeTrace(best.c, data.shades[shade.value]));
      traces.push(markTrace(Math.min(width / (east - west), (height - 100) / (north - south))), endTrace(best.c));
    }
    const b = data.beacons;
    if (b.length) traces.push({ x: b.map((k) => k.x), y: b.map((k) => k.y), text: b.map((k) => plain(k.name)), name: "beacons", type: "scatter", mode: "markers+text",
      textposition: "top center", marker: { symbol: "triangle-up", size: 13, color: data.colours.beacon, line: { color: css("--ink"), width: 1 } },
      customdata: b.map((k) => -k.z), hovertemplate: "<b>%{text}</b><br>%{x:.1f} E, %{y:.1f} N<br>depth %{customdata:.1f} m<extra></extra>" });
    const from = plan.positioned ? "" : " of where dead reckoning began";
    const below = shade.value ? (narrow() ? 86 : 70) : 0;  // a scale of colours
    draw("plan", traces, { height: height + below, margin: { t: 70, b: 44 + below },
      xaxis: { title: { text: `east${from} [m]` }, zeroline: false, range: frame.slice(0, 2), tickformat: ",d" },
      yaxis: { title: { text: `north${from} [m]` }, scaleanchor: "x", scaleratio: 1, zeroline: false, range: frame.slice(2), tickformat: ",d" } });
    scaledFor = null;
    follow({});
  };

  // --- errors -----------------------------------------------------------------------------------
  const errorForm = document.getElementById("error-form");
  const drawShares = (reference, title) => {
    const traces = data.errors.filter((e) => e.reference === reference).map((e) => {
      const c = columns(e), colour = data.colours.method[e.method];
      return { x: c.quantiles, y: c.quantiles.map((_, k) => k / (c.quantiles.length - 1)), name: e.method, type: "scatter", mode: "lines", line: { color: colour, width: 1.6 }, hovertemplate: `<b>${e.method}</b> %{y:.1%} within %{x:.2f} m<extra></extra>` };
    });
    const level = (share) => ({ type: "line", xref: "paper", x0: 0, x1: 1, y0: share, y1: share, line: { color: data.colours.bound, width: 1, dash: "dot" } });
    draw(`error-${reference}`, traces, { height: 380, uirevision: "shares", shapes: [level(0.5), level(0.95)], xaxis: { title: { text: title }, ...logarithmic, range: [Math.floor(Math.log10(Math.min(...traces.map((t) => quantile(t.x, 0.02)).filter((x) => x > 0)))), Math.log10(Math.max(...traces.map((t) => quantile(t.x, 1)))) + 0.1] },
      yaxis: { title: { text: "share of the dive" }, tickformat: ".0%", range: [0, 1.02], tickvals: [0, 0.25, 0.5, 0.75, 0.95] } });
  };
  const drawErrors = (reference, title) => {
    if (errorForm.value === "shares") { drawShares(reference, title); return; }
    const traces = data.errors.filter((e) => e.reference === reference).map((e) => {
      const c = columns(e);
      const sparse = reference === "fix" || e.method === "fix";
      return { x: times(c.t), y: c.y, text: c.t.map(clock), name: e.method, type: "scatter", mode: sparse ? "markers" : "lines",
        line: { color: data.colours.method[e.method], width: 1.5 }, marker: { color: data.colours.method[e.method], size: 4 },
        hovertemplate: `<b>${e.method}</b> %{y:.2f} m<br>%{x|%Y-%m-%d %H:%M:%S} UTC<br>dive %{text}<extra></extra>` };
    });
    draw(`error-${reference}`, traces, { height: 380, xaxis: { type: "date" }, yaxis: { title: { text: title }, ...logarithmic } });
  };

  const drawSigma = () => {
    const traces = data.sigma.map((e) => {
      const c = columns(e), colour = data.colours.method[e.method];
      return { x: times(c.t), y: c.y, text: c.t.map(clock), name: e.method, type: "scatter", mode: "lines", line: { color: colour, width: 1.5 },
        hovertemplate: `<b>${e.method}</b> 95 % within %{y:.2f} m by its own covariance<br>%{x|%Y-%m-%d %H:%M:%S} UTC<br>dive %{text}<extra></extra>` };
    });
    if (data.radius) {
      const c = columns(data.radius);
      traces.push({ x: times(c.begin.flatMap((t, k) => [t, c.end[k]])), y: c.y.flatMap((y) => Number.isFinite(y) ? [y, y] : [null, null]), name: "radius to rely on", type: "scatter", mode: "lines",
        line: { color: css("--ink"), width: 1.5, dash: "dot" }, hovertemplate: "<b>radius to rely on</b> %{y:.2f} m<br>%{x|%Y-%m-%d %H:%M:%S} UTC<extra></extra>" });
    }
    draw("sigma", traces, { height: 300, xaxis: { type: "date" }, yaxis: { title: { text: "95 % [m]" }, ...logarithmic } });
  };

  // --- innovations ------------------------------------------------------------------------------
  const innovationForm = document.getElementById("innovation-form");
  const beaconLayout = (more) => ({ height: Math.max(320, 60 + 170 * data.beacons.length), annotations: data.beacons.map((beacon, row) => ({
    text: `<b>${plain(beacon.name)}</b>`, x: 0.005, xref: "paper", y: 1 - row / data.beacons.length, yref: "paper", xanchor: "left", yanchor: "top", showarrow: false, bgcolor: "rgba(128,128,128,0.15)" })), ...more });
  const drawHistogram = (method) => {
    const edges = data.w_edges, middle = edges.slice(1).map((e, k) => 0.5 * (e + edges[k])), width = edges[1] - edges[0];
    const n = data.beacons.length, traces = [], layout = beaconLayout({ uirevision: `histogram ${method}`, barmode: "stack", bargap: 0.04, shapes: [] });
    const wAxis = { range: [edges[0], edges[edges.length - 1]], tickvals: [-6, -4, -2, 0, 2, 4, 6], ticktext: ["≤ -6", "-4", "-2", "0", "2", "4", "≥ 6"] };
    const wTitle = { title: { text: "w: innovation over its standard deviation" } };
    data.beacons.forEach((beacon, row) => {
      const counts = data.w[method][beacon.id] || [[], []];
      const axes = addAxes(layout, row, n, 0.045, row === n - 1 ? { ...wAxis, ...wTitle } : wAxis, { title: { text: "replies" }, nticks: 5 });
      for (const [name, k, colour] of [["accepted", 0, data.colours.accepted], ["rejected", 1, data.colours.rejected]])
        traces.push({ x: middle, y: counts[k], type: "bar", width, name, legendgroup: name, showlegend: !row, marker: { color: colour }, ...axes, hovertemplate: `<b>${plain(beacon.name)}</b> w %{x:.2f}: %{y} ${name}<extra></extra>` });
      const total = counts[0].reduce((a, b) => a + b, 0);
      traces.push({ x: middle, y: middle.map((w) => total * width * Math.exp(-0.5 * w * w) / Math.sqrt(2 * Math.PI)), type: "scatter", mode: "lines", name: "expected, normal", legendgroup: "expected", showlegend: !row,
        line: { color: css("--ink"), width: 1.4 }, hoverinfo: "skip", ...axes });
      if (data.gamma) for (const sign of [1, -1]) layout.shapes.push({ type: "line", xref: axes.xaxis, yref: `${axes.yaxis} domain`, x0: sign * Math.sqrt(data.gamma), x1: sign * Math.sqrt(data.gamma), y0: 0, y1: 1, line: { color: data.colours.bound, width: 1, dash: data.innovations[method].gated ? "solid" : "dot" } });
    });
    draw("innovations", traces, layout);
  };
  const drawInnovations = (method) => {
    if (innovationForm.value === "histogram") { drawHistogram(method); return; }
    const c = columns(data.innovations[method]);
    const limit = 2 * (quantile(c.bound_ms, 0.9) || quantile(c.ms.map(Math.abs), 0.9) || 10);
    const when = hover(c), traces = [], layout = beaconLayout({ uirevision: method });
    const looks = [["accepted", true, data.colours.accepted], ["rejected", false, data.colours.rejected]];
    data.beacons.forEach((beacon, row) => {
      const axes = addAxes(layout, row, data.beacons.length, 0.045, { type: "date" }, { range: [-limit, limit], title: { text: "[ms]" } });
      const rowsOf = c.t.map((_, k) => k).filter((k) => c.beacon[k] === beacon.id);
      for (const sign of [1, -1]) {
        if (!rowsOf.some((k) => Number.isFinite(c.bound_ms[k]))) break;
        traces.push({ x: times(rowsOf.map((k) => c.t[k])), y: rowsOf.map((k) => sign * c.bound_ms[k]), type: "scatter", mode: "lines", name: "gate", legendgroup: "gate",
          showlegend: !row && sign === 1, hoverinfo: "skip", line: { color: data.colours.bound, width: 1, dash: data.innovations[method].gated ? "solid" : "dot" }, ...axes });
      }
      for (const [name, taken, colour] of looks) {
        const rows = rowsOf.filter((k) => (c.decision[k] === 0) === taken);
        const symbol = (k) => c.ms[k] > limit ? "triangle-up" : c.ms[k] < -limit ? "triangle-down" : taken ? "circle" : "x";
        traces.push({ x: times(rows.map((k) => c.t[k])), y: rows.map((k) => Math.max(-0.95 * limit, Math.min(0.95 * limit, c.ms[k]))), type: "scatter", mode: "markers",
          name, legendgroup: name, showlegend: !row, marker: { color: colour, size: taken ? 4 : 6, symbol: rows.map(symbol) }, ...axes,
          text: rows.map((k) => `${when[k]}<br>${c.ms[k].toFixed(2)} ms, NIS ${c.nis[k].toPrecision(3)}<br>${data.decisions[c.decision[k]]}, arrival ${data.arrivals[c.arrival[k]]}${data.explanations[c.explanation[k]] && c.arrival[k] > 1 ? ": " + data.explanations[c.explanation[k]] : ""}`),
          hovertemplate: `<b>${plain(beacon.name)}</b><br>%{text}<extra></extra>` });
      }
    });
    draw("innovations", traces, layout);
  };

  const drawWatch = (method) => {
    const place = document.getElementById("watch");
    if (!place) return;
    if (!data.watch[method]) { draw("watch", [], {}); return; }
    const c = columns(data.watch[method]), traces = [];
    data.beacons.forEach((beacon) => {
      const rowsOf = c.begin.map((_, k) => k).filter((k) => c.beacon[k] === beacon.id);
      const both = rowsOf.flatMap((k) => [k, k]);
      const word = (k) => data.verdicts[c.verdict[k]];
      const metres = (value) => Number.isFinite(value) ? `${value.toFixed(1)} m` : "∞";
      traces.push({ x: times(both.map((k, j) => j % 2 ? c.end[k] : c.begin[k])), y: both.map((k) => Number.isFinite(c.smallest_m[k]) ? c.smallest_m[k] : null),
        type: "scatter", mode: "lines+markers", name: plain(beacon.name), line: { color: beacon.colour, width: 1.6 },
        marker: { color: beacon.colour, size: both.map((k) => c.verdict[k] ? 9 : 3), symbol: both.map((k) => c.verdict[k] ? "x" : "circle") },
        text: both.map((k) => `${word(k)}<br>minimal detectable bias ${metres(c.smallest_m[k])}<br>external reliability ${metres(c.unseen_m[k])}`),
        hovertemplate: `<b>${plain(beacon.name)}</b> %{text}<br>%{x|%Y-%m-%d %H:%M:%S} UTC<extra></extra>` });
    });
    draw("watch", traces, { height: 260, xaxis: { type: "date" }, yaxis: { title: { text: "detectable bias [m]" }, rangemode: "tozero" } });
  };

  // --- consistency ------------------------------------------------------------------------------
  const drawNis = () => {
    const edges = data.nis_edges, middle = edges.slice(1).map((e, k) => 0.5 * (e + edges[k]));
    const traces = Object.entries(data.nis).filter(([, h]) => h.n).map(([method, h]) => ({ x: middle, y: h.share, type: "bar",
      name: `${method} (${(100 * h.beyond).toFixed(1)} % beyond)`, marker: { color: data.colours.method[method] },
      hovertemplate: `<b>${method}</b><br>NIS %{x}: %{y:.1%}<extra></extra>` }));
    if (traces.length) traces.push({ x: middle, y: data.nis_expected, type: "scatter", mode: "lines+markers", name: "expected, χ²₁", line: { color: css("--ink"), width: 1.5 }, marker: { size: 4 } });
    draw("nis", traces, { height: 340, barmode: "group", xaxis: { title: { text: "NIS" } }, yaxis: { title: { text: "share of replies" }, tickformat: ".0%" } });
  };

  const drawEstimates = () => {
    const names = Object.keys(data.estimates);
    if (!names.length) { document.getElementById("estimates-part").remove(); return; }
    const rows = [["heading", "deg", "heading error [°]"], ["scale", "percent", "DVL scale [%]"], ["sound", "percent", "sound speed [%]"]];
    const traces = [], layout = { height: 560 };
    rows.forEach(([name, unit, title], row) => {
      const axes = addAxes(layout, row, 3, 0.04, { type: "date" }, { title: { text: title, font: { size: 10.5 } } });
      for (const method of names) {
        const c = columns(data.estimates[method]), colour = data.colours.method[method], value = c[`${name}_${unit}`], sigma = c[`${name}_sigma_${unit}`];
        for (const [k, width] of [[0, 1.6], [1, 0.6], [-1, 0.6]])
          traces.push({ x: times(c.t), y: value.map((v, j) => v + k * sigma[j]), type: "scatter", mode: "lines", name: method, legendgroup: method, showlegend: !row && !k,
            line: { color: colour, width }, hoverinfo: k ? "skip" : "x+y+name", ...axes });
      }
    });
    draw("estimates", traces, layout);
  };

  const drawProfile = () => {
    const titles = { depth: "depth [m]", altitude: "altitude [m]", heading: "heading [°]", speed: "speed [m/s]" };
    const names = Object.keys(titles).filter((name) => data.profile[name]), n = names.length, traces = [], layout = { height: 60 + 120 * n, showlegend: false, margin: { t: 10 } };
    names.forEach((name, row) => {
      const c = columns(data.profile[name]);
      const axes = addAxes(layout, row, n, 0.03, { type: "date" }, { title: { text: titles[name] }, zeroline: false, nticks: 5,
        ...(name === "depth" ? { autorange: "reversed" } : {}), ...(name === "heading" ? { range: [0, 360], tickvals: [0, 90, 180, 270, 360] } : {}), ...(name === "speed" || name === "altitude" ? { rangemode: "tozero" } : {}) });
      traces.push({ x: times(c.t), y: c.y, name, type: "scatter", mode: name === "heading" ? "markers" : "lines", line: { color: data.colours.depth, width: 1.3 }, marker: { color: data.colours.depth, size: 2 },
        text: c.t.map(clock), hovertemplate: `${titles[name].split(" ")[0]} %{y:.2f}<br>%{x|%Y-%m-%d %H:%M:%S} UTC<br>dive %{text}<extra></extra>`, ...axes });
    });
    draw("profile", traces, layout);
  };

  const choice = document.getElementById("innovation-method");
  const order = ["ekf", "ekf_gated", "ekf_ungated", "smoother"];
  for (const method of Object.keys(data.innovations).sort((a, b) => order.indexOf(a) - order.indexOf(b))) choice.add(new Option(method));
  choice.onchange = () => { drawInnovations(choice.value); drawWatch(choice.value); };
  innovationForm.onchange = () => drawInnovations(choice.value);
  const drawAllErrors = () => { for (const [reference, title] of [["truth", "error to truth [m]"], ["fix", "distance to fixes [m]"]]) if (document.getElementById(`error-${reference}`)) drawErrors(reference, title); };
  errorForm.onchange = drawAllErrors;
  shade.onchange = drawPlan;
  const drawAll = () => {
    drawPlan();
    drawAllErrors();
    drawSigma();
    if (choice.value) { drawInnovations(choice.value); drawWatch(choice.value); }
    drawNis();
    if (document.getElementById("estimates-part")) drawEstimates();
    drawProfile();
  };
  drawAll();
  const planPlace = document.getElementById("plan");
  if (planPlace.on) planPlace.on("plotly_relayout", follow);

  document.getElementById("theme").onclick = () => {
    const root = document.documentElement;
    root.dataset.theme = root.dataset.theme === "dark" ? "light" : "dark";
    drawAll();  // lines and letters of the page's own colour are in the traces too
  };
  let before = null;
  addEventListener("beforeprint", () => {
    before = document.documentElement.dataset.theme;
    document.documentElement.dataset.theme = "light";
    onPaper = true;
    drawAll();
    for (const fold of document.querySelectorAll("details")) fold.open = true;
  });
  addEventListener("afterprint", () => {
    document.documentElement.dataset.theme = before;
    onPaper = false;
    drawAll();
  });
  document.documentElement.dataset.ready = "yes";
})();
