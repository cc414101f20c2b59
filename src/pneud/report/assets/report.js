"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const runs = data.runs, several = runs.length > 1, root = document.documentElement;
  if (runs.length > 7) document.body.classList.add("many");

  // colours, which are lighter where the page is dark
  let theme = new Map();
  const css = name => {
    if (!theme.has(name)) theme.set(name, getComputedStyle(root).getPropertyValue(name).trim());
    return theme.get(name);
  };
  const paint = colour => css("--c-" + colour.slice(1)) || colour;

  // markers of a legend, which follow the page
  const legend = (colours, extra) => ({ markers: { stroke: (u, i) => `var(--c-${colours[i].slice(1)}, ${colours[i]})` }, ...extra });
  const deep = colour => [1, 3, 5].reduce((sum, at, k) => sum + parseInt(colour.slice(at, at + 2), 16) * [0.3, 0.59, 0.11][k], 0) < 110;

  const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
  const doubles = text => new Float64Array(bytes(text).buffer);
  // a gap is null to uPlot
  const floats = text => Array.from(new Float32Array(bytes(text).buffer), v => Number.isFinite(v) ? v : null);
  for (const run of runs) {
    run.t = Array.from(doubles(run.t));
    for (const name in run.columns) run.columns[name] = floats(run.columns[name]);
    run.phase = { t: doubles(run.phase.t), x: floats(run.phase.x), y: floats(run.phase.y) };
    run.view = run;  // what is drawn: the overview, and every tick of what is looked at
    run.shown = true;
  }
  const whole = [Math.min(...runs.map(r => r.t[0])), Math.max(...runs.map(r => r.t[r.t.length - 1]))];
  if (whole[0] === whole[1]) whole[1] += 1e-3;

  // all plots over time share their left edge
  const longest = Math.max(8, ...runs.flatMap(r => [several ? r.name.length : 0, ...r.faults.map(f => f.name.length)]));
  const narrow = document.body.clientWidth < 700;
  const LEFT = narrow ? 62 : Math.min(180, Math.max(64, 14 + 7 * longest));
  const FONT = `${narrow ? 11 : 12}px system-ui, sans-serif`;

  const plots = [], planes = [];
  let linking = false, phase = null;

  const width = element => Math.max(240, Math.floor(element.clientWidth));
  // as many decimals as the distance of the ticks has; uPlot's own stop at three
  const numbers = (u, splits, index, space, step) => {
    const decimals = step >= 1e-6 ? (String(step).split(".")[1] || "").length : 9;
    return splits.map(v => v == null ? "" : Math.abs(v) >= 1e5 ? v.toExponential(2) : v.toFixed(decimals));
  };
  const axis = (label, extra) => Object.assign({
    stroke: () => css("--soft"), values: numbers, label, labelSize: 20, labelFont: FONT, font: FONT,
    grid: { stroke: () => css("--grid"), width: 1 }, ticks: { stroke: () => css("--grid"), width: 1 },
  }, extra);
  const across = label => axis(label, { size: label ? 30 : 28, labelSize: 18 });
  const timeAxis = last => across(last ? (data.aligned ? "s from engaging" : "s") : null);
  const digits = v => v == null ? "–" : Math.abs(v) >= 1e5 || (v !== 0 && Math.abs(v) < 1e-3) ? v.toExponential(3)
    : v.toPrecision(Math.abs(v) >= 1 ? 6 : 4);
  const seconds = v => v == null ? "–" : v.toFixed(4) + " s";

  const save = (name, content, type) => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([content], { type }));
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  };
  const picture = (u, title, name) => {
    const from = u.ctx.canvas, to = document.createElement("canvas"), head = 26 * devicePixelRatio;
    to.width = from.width; to.height = from.height + head;
    const ctx = to.getContext("2d");
    ctx.fillStyle = css("--paper"); ctx.fillRect(0, 0, to.width, to.height);
    ctx.fillStyle = css("--ink"); ctx.font = `bold ${14 * devicePixelRatio}px system-ui, sans-serif`;
    ctx.fillText(title, 8 * devicePixelRatio, 18 * devicePixelRatio);
    ctx.drawImage(from, 0, head);
    to.toBlob(blob => save(name + ".png", blob, "image/png"));
  };
  const quoted = v => v == null ? "" : /[",\n]/.test(v) ? `"${String(v).replaceAll('"', '""')}"` : v;
  const csv = (name, rows) => save(name + ".csv", rows.map(r => r.map(quoted).join(",")).join("\n") + "\n", "text/csv");

  // heading with buttons; `rows` makes what goes into the CSV
  const heading = (element, title, note, name, rows) => {
    const h = document.createElement("h3"), words = document.createElement("span");
    words.textContent = title; h.append(words);
    if (note) { const small = document.createElement("small"); small.textContent = " – " + note; words.append(small); }
    const button = (label, act) => {
      const b = document.createElement("button");
      b.textContent = label; b.ariaLabel = `${title} as ${label}`; b.onclick = act; h.append(b);
    };
    if (rows) { button("PNG", () => picture(element.plot, title, name)); button("CSV", () => csv(name, rows())); }
    element.append(h);
  };
  const keep = (element, u, list, title) => {
    u.home = element; element.plot = u; list.push(u);
    u.root.setAttribute("role", "group"); u.root.setAttribute("aria-label", title);
    return u;
  };

  // every tick of what is looked at

  const MOST = 80000;  // ticks in view that are drawn one by one
  async function decode(stretch) {
    const [begin, , count, packed] = stretch;
    const stream = new Blob([bytes(packed)]).stream().pipeThrough(new DecompressionStream("deflate"));
    const raw = new Uint8Array(await new Response(stream).arrayBuffer());
    const found = { begin, end: stretch[1], columns: {} };
    data.steps.forEach((step, k) => {
      const base = 4 * k * count, values = new Array(count);
      for (let i = 0, sum = 0; i < count; i++) {
        const z = raw[base + i] | raw[base + count + i] << 8 | raw[base + 2 * count + i] << 16 | raw[base + 3 * count + i] << 24;
        sum = sum + ((z >>> 1) ^ -(z & 1)) | 0;
        values[i] = sum === -2147483648 ? null : sum * step;
      }
      if (k) found.columns[data.columns[k - 1]] = values;
      else found.t = values.map(t => begin + t);
    });
    return found;
  }
  const within = (run, min, max) => run.closeup.filter(s => s[1] >= min && s[0] <= max);
  async function looked(run, min, max) {
    const chosen = within(run, min, max);
    if (!chosen.length || chosen.reduce((n, s) => n + s[2], 0) > MOST || !self.DecompressionStream) return run;
    const parts = await Promise.all(chosen.map(s => s.decoded ||= decode(s)));
    const view = { t: [], columns: {} }, names = Object.keys(run.columns);
    for (const name of names) view.columns[name] = [];
    let at = 0;
    const overview = end => {
      while (at < run.t.length && run.t[at] < end) {
        view.t.push(run.t[at]);
        for (const name of names) view.columns[name].push(run.columns[name][at]);
        at++;
      }
    };
    for (const part of parts) {
      overview(part.begin);
      for (const t of part.t) view.t.push(t);
      for (const name of names) { const to = view.columns[name]; for (const v of part.columns[name]) to.push(v); }
      while (at < run.t.length && run.t[at] <= part.end) at++;
    }
    overview(Infinity);
    return view;
  }
  const told = seconds => seconds < 1 ? `${+(1e3 * seconds).toPrecision(3)} ms` : `${+seconds.toPrecision(3)} s`;
  function resolution(min, max) {
    const run = runs[0], coarse = 2 * (run.t[run.t.length - 1] - run.t[0]) / Math.max(1, run.t.length - 1);
    const kept = run.closeup.reduce((sum, s) => sum + s[1] - s[0], 0);
    const shows = `Shown: ${runs.every(r => r.view !== r) || coarse < 2.5 * run.period ? "every tick"
      : runs.some(r => r.view !== r) ? "every tick where it is kept, else the least and greatest value of " + told(coarse)
      : "the least and greatest value of every " + told(coarse)}.`;
    return coarse < 2.5 * run.period ? shows : `${shows} Every tick is kept of ${told(kept)}`
      + `${several ? " of the first log" : ""} in ${run.closeup.length} stretch${run.closeup.length === 1 ? "" : "es"}`
      + " (those with events first, then those with the greatest errors); zoom in to see them.";
  }
  let looking = 0;
  async function look(min, max) {
    const mine = ++looking;
    const views = await Promise.all(runs.map(run => looked(run, min, max)));
    if (mine !== looking) return;
    const changed = views.some((view, i) => view !== runs[i].view);
    runs.forEach((run, i) => { run.view = views[i]; });
    document.getElementById("resolution").textContent = resolution(min, max);
    if (!changed) return;
    linking = true;
    for (const u of plots) if (u.table) { u.setData(u.table(), false); u.setScale("x", { min, max }); }
    linking = false;
    if (phase) phase.show(min, max);
  }

  const zoom = (min, max) => plots[0].setScale("x", { min, max });
  let waiting = 0;
  const link = {
    hooks: {
      setScale: [(u, key) => {
        if (key !== "x" || linking || !u.ready) return;
        linking = true;
        const { min, max } = u.scales.x;
        for (const other of plots) if (other !== u) other.setScale("x", { min, max });
        linking = false;
        if (phase) phase.show(min, max);
        clearTimeout(waiting);
        waiting = setTimeout(() => look(min, max), 60);
      }],
      ready: [u => { u.ready = true; }],
      setCursor: [u => { if (phase && u.cursor.left >= 0) phase.point(u.posToVal(u.cursor.left, "x")); }],
    },
  };

  // marks of the operator, stretches without ticks, and settling, behind every plot over time
  const behind = settling => ({
    hooks: {
      drawClear: [u => {
        const { ctx, bbox } = u, { min, max } = u.scales.x;
        const band = (begin, end, colour) => {
          if (end < min || begin > max) return;
          const left = u.valToPos(begin, "x", true), right = u.valToPos(end, "x", true);
          ctx.fillStyle = colour;
          ctx.fillRect(left, bbox.top, Math.max(devicePixelRatio, right - left), bbox.height);
        };
        ctx.save();
        ctx.beginPath(); ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height); ctx.clip();
        for (const run of runs) {
          if (!run.shown) continue;
          if (settling) for (const [begin, end] of run.settled) band(begin, end, css("--settling"));
          for (const [begin, end, kind] of run.gaps) band(begin, end, css(kind === 2 ? "--lost" : "--gap"));
          ctx.strokeStyle = several ? paint(run.colour) : css("--soft");
          ctx.lineWidth = devicePixelRatio;
          ctx.setLineDash([3 * devicePixelRatio, 3 * devicePixelRatio]);
          for (const [t] of run.marks) {
            if (t < min || t > max) continue;
            const x = Math.round(u.valToPos(t, "x", true)) + 0.5;
            ctx.beginPath(); ctx.moveTo(x, bbox.top); ctx.lineTo(x, bbox.top + bbox.height); ctx.stroke();
          }
        }
        ctx.restore();
      }],
    },
  });

  const common = (element, height, settling) => ({
    width: width(element), height,
    cursor: { sync: { key: "time", setSeries: false }, drag: { x: true, y: false }, points: { size: 5 },
      focus: { prox: several ? 24 : -1 } },
    focus: { alpha: 0.25 },
    scales: { x: { time: false, range: (u, min, max) => min == null ? whole : [min, max] } },
    plugins: [link, behind(settling)],
  });

  function over(figure, last) {
    const lines = [], series = [{ label: "t", value: (u, v) => seconds(v) }], shares = [];
    for (const run of runs) {
      const there = figure.series.filter(s => run.columns[s.column]);
      if (!there.length) continue;
      shares.push([run, there]);
      for (const s of there) {
        lines.push({ run, main: s === figure.series[0], colour: several ? run.colour : s.colour });
        series.push({
          label: several ? `${run.name}: ${s.label}` : s.label, width: 1.2,
          stroke: () => paint(several ? run.colour : s.colour), dash: several && s !== figure.series[0] ? [5, 3] : undefined,
          show: !several || s === figure.series[0], spanGaps: false, points: { show: false },
          value: (u, v) => digits(v),
        });
      }
    }
    if (!shares.length) return;
    const element = document.createElement("div"), title = `${figure.title} [${figure.unit}]`;
    element.className = "plot";
    element.id = "plot-" + figure.name;
    document.getElementById("plots").append(element);
    const table = () => {
      const tables = shares.map(([run, there]) => [run.view.t, ...there.map(s => run.view.columns[s.column])]);
      return tables.length > 1 ? uPlot.join(tables) : tables[0];
    };
    heading(element, title, figure.note, figure.name, () => {
      const { data: [t, ...values], scales: { x: { min, max } } } = element.plot, rows = [series.map((s, i) => i ? `${s.label} [${figure.unit}]` : "t [s]")];
      t.forEach((v, i) => { if (v >= min && v <= max) rows.push([v.toFixed(6), ...values.map(y => y[i])]); });
      return rows;
    });
    const options = common(element, narrow ? 180 : 210, figure.name === "tracking" || figure.name === "error");
    options.series = series;
    options.legend = legend(["", ...lines.map(l => l.colour)]);
    options.axes = [timeAxis(last), axis(null, { size: LEFT })];
    const u = keep(element, new uPlot(options, table(), element), plots, title);
    u.table = table; u.lines = lines;
  }

  function timeline() {
    const rows = [];
    for (const run of runs) {
      rows.push({ name: several ? run.name : "state", run, kind: "state" });
      if (!several && run.saturated.length) rows.push({ name: "saturated", run, kind: "saturated" });
      for (const fault of run.faults) if (!several || fault.latched.length) rows.push({ name: fault.name, run, kind: "fault", fault });
      if (!several && run.marks.length) rows.push({ name: "operator", run, kind: "marks" });
      if (run.closeup.length && !several) rows.push({ name: "detail", run, kind: "closeup" });
    }
    const element = document.getElementById("timeline"), title = "States, faults and requests";
    heading(element, title, "a fault is light while it is present, dark while it is latched");
    const count = rows.length;
    const fitting = Math.floor((LEFT - 12) / 6.6);
    const short = name => name.length > fitting ? name.slice(0, fitting - 1) + "…" : name;
    const bands = {
      hooks: {
        draw: [u => {
          const { ctx, bbox } = u, { min, max } = u.scales.x, high = bbox.height / count, ratio = devicePixelRatio;
          ctx.save();
          ctx.beginPath(); ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height); ctx.clip();
          ctx.font = `${11 * ratio}px system-ui, sans-serif`;
          ctx.textBaseline = "middle";
          ctx.textAlign = "left";
          const band = (row, begin, end, colour, part, text) => {
            if (end < min || begin > max) return;
            const left = Math.max(bbox.left, u.valToPos(begin, "x", true));
            const right = Math.min(bbox.left + bbox.width, u.valToPos(end, "x", true));
            const top = bbox.top + high * (row + (1 - part) / 2);
            ctx.fillStyle = colour;
            ctx.fillRect(left, top, Math.max(ratio, right - left), high * part);
            if (text && right - left > ctx.measureText(text).width + 8 * ratio) {
              ctx.fillStyle = deep(colour) ? "#fff" : "#000";
              ctx.fillText(text, left + 4 * ratio, top + high * part / 2);
            }
          };
          rows.forEach((row, i) => {
            if (row.kind === "state")
              for (const [begin, end, name, colour] of row.run.states) band(i, begin, end, paint(colour), 0.8, name);
            else if (row.kind === "saturated")
              for (const [begin, end] of row.run.saturated) band(i, begin, end, paint("#e69f00"), 0.6);
            else if (row.kind === "closeup")
              for (const [begin, end] of row.run.closeup) band(i, begin, end, css("--soft"), 0.2);
            else if (row.kind === "fault") {
              for (const [begin, end] of row.fault.present) band(i, begin, end, css("--present"), 0.8);
              for (const [begin, end] of row.fault.latched) band(i, begin, end, paint("#d55e00"), 0.4);
            } else {
              let free = -Infinity;
              ctx.fillStyle = css("--ink");
              const seen = row.run.marks.filter(([t]) => t >= min && t <= max);
              for (const [k, [t, text]] of seen.entries()) {
                const x = u.valToPos(t, "x", true), y = bbox.top + high * (i + 0.5);
                const next = k + 1 < seen.length ? u.valToPos(seen[k + 1][0], "x", true) : Infinity;
                ctx.beginPath(); ctx.arc(x, y, 3 * ratio, 0, 7); ctx.fill();
                const wide = ctx.measureText(text).width;
                let at = x + 6 * ratio;
                if (at + wide > bbox.left + bbox.width) at = x - wide - 6 * ratio;
                if (at > free && at + wide < next - 3 * ratio) { ctx.fillText(text, at, y); free = at + wide + 6 * ratio; }
              }
            }
          });
          ctx.restore();
        }],
      },
    };
    const options = common(element, 24 * count + 66, false);
    options.plugins.push(bands);
    options.legend = { show: true };
    options.scales.y = { range: [0, count] };
    const naming = t => rows.filter(r => r.kind === "state").map(r => {
      const span = r.run.states.find(s => s[0] <= t && t < s[1]);
      return (several ? r.name + ": " : "") + (span ? span[2] : "–");
    }).join(", ");
    options.series = [{ label: "t", value: (u, v) => seconds(v) },
      { label: "state", paths: () => null, points: { show: false }, value: (u, v, s, i) => i == null ? "–" : naming(u.data[0][i]) }];
    options.axes = [timeAxis(false), axis(null, {
      size: LEFT, grid: { show: false }, splits: () => rows.map((r, i) => count - i - 0.5),
      values: (u, splits) => splits.map((s, i) => short(rows[i].name)),
    })];
    const grid = [];
    for (let i = 0; i <= 2000; i++) grid.push(whole[0] + (whole[1] - whole[0]) * i / 2000);
    keep(element, new uPlot(options, [grid, grid.map(() => 0)], element), plots, title);
  }

  // figures that are not over time: lines, points, bars and marks in a plane

  const inside = (u, draw) => {
    const { ctx, bbox } = u;
    ctx.save();
    ctx.beginPath(); ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height); ctx.clip();
    draw(ctx, bbox);
    ctx.restore();
  };
  const tracer = traces => (u, index) => {
    const trace = traces[index - 1], [x, y] = u.data[index];
    inside(u, (ctx, bbox) => {
      const px = v => u.valToPos(v, "x", true), py = v => u.valToPos(v, "y", true);
      ctx.strokeStyle = ctx.fillStyle = paint(trace.colour);
      ctx.lineWidth = (trace.kind === "line" ? 1.2 : 1.5) * devicePixelRatio;
      ctx.beginPath();
      if (trace.kind === "bars") {
        const wide = Math.max(1, (x.length > 1 ? px(x[1]) - px(x[0]) : 8) - 1), floor = py(0);
        for (let i = 0; i < x.length; i++) ctx.rect(px(x[i]) - wide / 2, py(y[i]), wide, floor - py(y[i]));
        ctx.fill();
      } else if (trace.kind === "mark") {
        ctx.setLineDash([5 * devicePixelRatio, 4 * devicePixelRatio]);
        ctx.moveTo(px(x[0]), bbox.top); ctx.lineTo(px(x[0]), bbox.top + bbox.height); ctx.stroke();
      } else {
        let down = false;
        for (let i = 0; i < x.length; i++) {
          if (!Number.isFinite(x[i]) || !Number.isFinite(y[i])) { down = false; continue; }
          if (down) ctx.lineTo(px(x[i]), py(y[i])); else ctx.moveTo(px(x[i]), py(y[i]));
          down = true;
        }
        ctx.stroke();
      }
    });
    return null;
  };
  const reach = (tables, k, logarithmic) => {
    let low = Infinity, high = -Infinity;
    for (const part of tables) for (const v of part[k]) if (Number.isFinite(v) && (!logarithmic || v > 0)) { if (v < low) low = v; if (v > high) high = v; }
    if (!(low <= high)) [low, high] = logarithmic ? [0.1, 1] : [-1, 1];
    if (logarithmic) return [low / 1.2, high * 1.2];
    const margin = 0.05 * (high - low) || 0.05 * Math.abs(high) || 1;
    return [low - margin, high + margin];
  };

  function plane(figure) {
    const traces = figure.traces.map(t => ({ ...t, x: floats(t.x), y: floats(t.y) }));
    const element = document.createElement("div"), first = new Set();
    element.className = "plot"; element.id = "plane-" + figure.name;
    document.getElementById("planes").append(element);
    heading(element, figure.title, figure.note, figure.name, () => [["line", figure.across, figure.up],
      ...traces.flatMap(t => Array.from(t.x, (x, i) => [t.label, x, t.y[i]]))]);
    const tables = traces.map(t => [t.x, t.y]), kept = traces.filter(t => t.kind !== "mark").map(t => [t.x, t.y]);
    const ranges = [reach(tables, 0, figure.logarithmic), reach(kept, 1, figure.logarithmic)];
    if (figure.name === "valve") ranges[1][0] = 0;
    const distr = figure.logarithmic ? 3 : 1;
    const powers = (low, high) => { const found = []; for (let k = Math.ceil(Math.log10(low)); k <= Math.log10(high); k++) found.push(+`1e${k}`); return found; };
    const decades = figure.logarithmic ? { splits: (u, k, low, high) => powers(low, high), values: (u, splits) => splits.map(String), filter: (u, splits) => splits } : {};
    keep(element, new uPlot({
      mode: 2, width: width(element), height: 300, cursor: { show: false }, legend: legend(["", ...traces.map(t => t.colour)], { show: traces.length > 1, live: false }),
      scales: { x: { time: false, distr, range: () => ranges[0] }, y: { distr, range: () => ranges[1] } },
      series: [null, ...traces.map(t => ({ label: t.label, stroke: () => paint(t.colour), paths: tracer(traces) }))],
      axes: [Object.assign(across(figure.across), decades), axis(figure.up, { size: 58, ...decades })],
    }, [null, ...tables], element), planes, figure.title);
    for (const row of element.querySelectorAll(".u-legend .u-series")) {  // the same words once
      if (first.has(row.textContent)) row.remove(); else first.add(row.textContent);
    }
  }

  function phasePlot() {
    const element = document.getElementById("phase"), title = "Phase plot";
    if (!runs.some(r => r.phase.t.length)) return;
    let ranges, shown;
    heading(element, title, "of the time shown above; the dot follows the cursor", "phase",
      () => [["log", "position error [mm]", "velocity error [mm/s]"], ...shown.flatMap((p, k) => p[0].map((x, i) => [runs[k].name, x, p[1][i]]))]);
    const points = run => {  // every tick where it is there
      if (run.view === run) return run.phase;
      if (run.view.phase) return run.view.phase;
      const { t, columns: c } = run.view;
      return run.view.phase = { t, x: c.error_mm, y: c.reference_mm_s.map((r, i) => r == null ? null : r - c.velocity_mm_s[i]) };
    };
    const part = (run, min, max) => {
      const x = [], y = [], p = points(run);
      for (let i = 0; i < p.t.length; i++)
        if (p.t[i] >= min && p.t[i] <= max && p.x[i] != null && p.y[i] != null) { x.push(p.x[i]); y.push(p.y[i]); }
      return run.shown ? [x, y] : [[], []];
    };
    const selected = (min, max) => {
      shown = runs.map(run => part(run, min, max));
      ranges = [0, 1].map(k => reach(shown, k, false));
      return [null, ...shown];
    };
    const traces = runs.map(run => ({ colour: run.colour, kind: "line" }));
    const u = keep(element, new uPlot({
      mode: 2, width: width(element), height: narrow ? 320 : 420, cursor: { show: false }, legend: legend(["", ...traces.map(t => t.colour)], { show: several, live: false }),
      scales: { x: { time: false, range: () => ranges[0] }, y: { range: () => ranges[1] } },
      series: [null, ...runs.map(run => ({ label: run.name, stroke: () => paint(run.colour), paths: tracer(traces) }))],
      axes: [across("position error [mm]"), axis("velocity error [mm/s]", { size: 64 })],
    }, selected(...whole), element), planes, title);
    const dots = runs.map(run => {
      const dot = document.createElement("div");
      dot.style.cssText = "position:absolute;width:9px;height:9px;margin:-5px 0 0 -5px;border-radius:5px;display:none;"
        + `border:1px solid #fff;background:${several ? run.colour : "#d55e00"}`;
      u.over.append(dot);
      return dot;
    });
    phase = {
      show(min, max) { u.setData(selected(min, max)); dots.forEach(dot => { dot.style.display = "none"; }); },
      point(t) {
        runs.forEach((run, k) => {
          const p = points(run), times = p.t, dot = dots[k];
          let low = 0, high = times.length - 1;
          while (low < high) { const mid = (low + high) >> 1; if (times[mid] < t) low = mid + 1; else high = mid; }
          const x = p.x[low], y = p.y[low];
          const there = run.shown && times.length && x != null && y != null && Math.abs(times[low] - t) < (whole[1] - whole[0]) / 200
            && x >= ranges[0][0] && x <= ranges[0][1] && y >= ranges[1][0] && y <= ranges[1][1];
          dot.style.display = there ? "block" : "none";
          if (there) { dot.style.left = u.valToPos(x, "x") + "px"; dot.style.top = u.valToPos(y, "y") + "px"; }
        });
      },
    };
  }

  // a fault, close up

  const CLOSE = [["tracking", "Position [mm]"], ["velocity", "Velocity [mm/s]"], ["pressures", "Pressures [bar]"], ["command", "Valve command [V]"]];
  async function closeup(element) {
    const run = runs[+element.dataset.run], moments = run.stops[+element.dataset.fault];
    const at = moments.find(m => m[1].endsWith("latched"))[0], last = Math.max(...moments.map(m => m[0]));
    const min = Math.max(run.t[0], Math.max(at - 1, Math.min(at, moments[0][0])) - 0.25), max = Math.min(run.t[run.t.length - 1], Math.max(last, at + 0.2) + 0.25);
    const view = await looked(run, min, max);
    const first = view.t.findIndex(t => t >= min), end = view.t.findLastIndex(t => t <= max) + 1;
    for (const [name, title] of CLOSE) {
      const figure = data.figures.find(f => f.name === name), there = figure.series.filter(s => run.columns[s.column]);
      if (!there.length) continue;
      const home = document.createElement("div");
      home.className = "plot";
      element.append(home);
      heading(home, title);
      const lines = { hooks: { draw: [u => inside(u, (ctx, bbox) => {
        ctx.strokeStyle = ctx.fillStyle = css("--bad");
        ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
        ctx.setLineDash([4 * devicePixelRatio, 3 * devicePixelRatio]);
        moments.forEach(([t, word], i) => {
          const x = u.valToPos(t, "x", true);
          ctx.beginPath(); ctx.moveTo(x, bbox.top); ctx.lineTo(x, bbox.top + bbox.height); ctx.stroke();
          ctx.textAlign = t > (min + max) / 2 ? "right" : "left";
          ctx.fillText(word, x + (t > (min + max) / 2 ? -3 : 3) * devicePixelRatio, bbox.top + (11 + 12 * i) * devicePixelRatio);
        });
      })] } };
      keep(home, new uPlot({
        width: width(home), height: 190, cursor: { show: false }, legend: legend(["", ...there.map(s => s.colour)], { live: false }), plugins: [lines],
        scales: { x: { time: false, range: () => [min, max] } },
        series: [{ label: "t" }, ...there.map(s => ({ label: s.label, width: 1.2, stroke: () => paint(s.colour), points: { show: false } }))],
        axes: [across("s"), axis(null, { size: 52 })],
      }, [view.t.slice(first, end), ...there.map(s => view.columns[s.column].slice(first, end))], home), planes, title);
    }
  }

  timeline();
  const shown = data.figures.filter(f => runs.some(r => f.series.some(s => r.columns[s.column])));
  shown.forEach((figure, i) => over(figure, i === shown.length - 1));
  phasePlot();
  data.planes.forEach(plane);
  root.dataset.drawn = String(plots.length + planes.length);
  const closeups = [...document.querySelectorAll(".closeup")].map(closeup);
  Promise.all(closeups).then(() => { root.dataset.closeups = String(closeups.length); });
  look(...whole);

  // buttons of the tables

  for (const table of document.querySelectorAll("table[data-name]")) {
    const b = document.createElement("button");
    b.textContent = "CSV"; b.ariaLabel = "table as CSV";
    b.onclick = () => csv(table.dataset.name, [...table.rows].map(r => [...r.cells].slice(0, -1).map(c => c.textContent)));
    table.parentElement.after(b);
  }
  for (const b of document.querySelectorAll("button[data-from]"))
    b.onclick = () => { zoom(+b.dataset.from, +b.dataset.to); document.getElementById("timeline").scrollIntoView(); };
  for (const b of document.querySelectorAll("button[data-run]")) b.onclick = () => {
    const run = runs[+b.dataset.run];
    run.shown = !run.shown;
    b.ariaPressed = String(run.shown);
    for (const u of plots) (u.lines || []).forEach((l, i) => { if (l.run === run && l.main) u.setSeries(i + 1, { show: run.shown }); });
    if (phase) phase.show(plots[0].scales.x.min, plots[0].scales.x.max);
  };

  const everything = () => [...plots, ...planes];
  const fit = to => {
    for (const u of everything()) {
      const wanted = Math.min(to || Infinity, width(u.home));
      if (u.width !== wanted) u.setSize({ width: wanted, height: u.height });
    }
  };
  const repaint = () => { theme = new Map(); for (const u of everything()) u.redraw(false, true); };
  let frame = 0;
  for (const d of document.querySelectorAll("details")) d.addEventListener("toggle", () => fit());
  addEventListener("resize", () => { cancelAnimationFrame(frame); frame = requestAnimationFrame(() => fit()); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
  // paper is white, and narrower than most windows; what is drawn for it stays sharp
  addEventListener("beforeprint", () => {
    root.dataset.print = ""; fit(660); repaint();
    for (const d of document.querySelectorAll("details")) { d.dataset.was = d.open; d.open = true; }
  });
  addEventListener("afterprint", () => {
    delete root.dataset.print; fit(); repaint();
    for (const d of document.querySelectorAll("details")) d.open = d.dataset.was === "true";
  });
})();
