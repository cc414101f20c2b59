"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const runs = data.runs, several = runs.length > 1;
  const INK = "#1b1f24", SOFT = "#5c6570", GRID = "#e6e9ed";

  const buffer = text => Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer;
  const doubles = text => new Float64Array(buffer(text));
  // a gap is null to uPlot
  const floats = text => Array.from(new Float32Array(buffer(text)), v => Number.isFinite(v) ? v : null);
  for (const run of runs) {
    run.t = Array.from(doubles(run.t));
    for (const name in run.columns) run.columns[name] = floats(run.columns[name]);
    run.phase = { t: doubles(run.phase.t), x: floats(run.phase.x), y: floats(run.phase.y) };
  }
  const whole = [Math.min(...runs.map(r => r.t[0])), Math.max(...runs.map(r => r.t[r.t.length - 1]))];
  if (whole[0] === whole[1]) whole[1] += 1e-3;

  // all plots over time share their left edge
  const longest = Math.max(8, ...runs.flatMap(r => [several ? r.name.length : 0, ...r.faults.map(f => f.name.length)]));
  const narrow = document.body.clientWidth < 700;
  const LEFT = narrow ? 84 : Math.min(180, Math.max(64, 14 + 7 * longest));

  const plots = [];
  let linking = false, phase = null;

  const width = element => Math.max(280, Math.floor(element.clientWidth));
  // as many decimals as the distance of the ticks has; uPlot's own stop at three
  const numbers = (u, splits, index, space, step) => {
    const decimals = step >= 1e-6 ? (String(step).split(".")[1] || "").length : 9;
    return splits.map(v => Math.abs(v) >= 1e5 ? v.toExponential(2) : v.toFixed(decimals));
  };
  const axis = (label, extra) => Object.assign({
    stroke: SOFT, values: numbers, grid: { stroke: GRID, width: 1 }, ticks: { stroke: GRID, width: 1 }, label, labelSize: 20,
    labelFont: "12px system-ui, sans-serif", font: "12px system-ui, sans-serif",
  }, extra);
  const timeAxis = last => axis(last ? (data.aligned ? "s from engaging" : "s") : null, last ? {} : { label: null });
  const digits = v => v == null ? "–" : Math.abs(v) >= 1e5 || (v !== 0 && Math.abs(v) < 1e-3) ? v.toExponential(3)
    : v.toPrecision(Math.abs(v) >= 1 ? 6 : 4);
  const seconds = v => v == null ? "–" : v.toFixed(3) + " s";

  const link = {
    hooks: {
      setScale: [(u, key) => {
        if (key !== "x" || linking || !u.ready) return;
        linking = true;
        const { min, max } = u.scales.x;
        for (const other of plots) if (other !== u) other.setScale("x", { min, max });
        linking = false;
        if (phase) phase.show(min, max);
      }],
      ready: [u => { u.ready = true; }],
      setCursor: [u => { if (phase && u.cursor.left >= 0) phase.point(u.posToVal(u.cursor.left, "x")); }],
    },
  };

  // marks of the operator and stretches without ticks, behind every plot over time
  const behind = {
    hooks: {
      drawClear: [u => {
        const { ctx, bbox } = u, { min, max } = u.scales.x;
        ctx.save();
        ctx.beginPath(); ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height); ctx.clip();
        for (const run of runs) {
          for (const [begin, end, kind] of run.gaps) {
            if (end < min || begin > max) continue;
            const left = u.valToPos(begin, "x", true), right = u.valToPos(end, "x", true);
            ctx.fillStyle = kind === 2 ? "#f6c9ae" : "#f3e9d2";
            ctx.fillRect(left, bbox.top, Math.max(1, right - left), bbox.height);
          }
          ctx.strokeStyle = several ? run.colour : "#8a93a0";
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
  };

  const common = (element, height) => ({
    width: width(element), height,
    cursor: { sync: { key: "time", setSeries: false }, drag: { x: true, y: false }, points: { size: 5 } },
    scales: { x: { time: false, range: (u, min, max) => min == null ? whole : [min, max] } },
    plugins: [link, behind],
  });

  const heading = (element, title, note) => {
    const h = document.createElement("h3");
    h.textContent = title;
    if (note) { const small = document.createElement("small"); small.textContent = " – " + note; h.append(small); }
    element.append(h);
  };

  function over(figure, last) {
    const tables = [], series = [{ label: "t", value: (u, v) => seconds(v) }];
    for (const run of runs) {
      const there = figure.series.filter(s => run.columns[s.column]);
      if (!there.length) continue;
      tables.push([run.t, ...there.map(s => run.columns[s.column])]);
      for (const s of there) {
        series.push({
          label: several ? `${run.name}: ${s.label}` : s.label, width: 1.2,
          stroke: several ? run.colour : s.colour, dash: several && s !== figure.series[0] ? [5, 3] : undefined,
          show: !several || s === figure.series[0], spanGaps: false, points: { show: false },
          value: (u, v) => digits(v),
        });
      }
    }
    if (!tables.length) return;
    const element = document.createElement("div");
    element.className = "plot";
    element.id = "plot-" + figure.name;
    document.getElementById("plots").append(element);
    heading(element, `${figure.title} [${figure.unit}]`, figure.note);
    const options = common(element, 210);
    options.series = series;
    options.axes = [timeAxis(last), axis(null, { size: LEFT })];
    plots.push(new uPlot(options, tables.length > 1 ? uPlot.join(tables) : tables[0], element));
    plots[plots.length - 1].home = element;
  }

  function timeline() {
    const rows = [];
    for (const run of runs) {
      rows.push({ name: several ? run.name : "state", run, kind: "state" });
      if (run.saturated.length) rows.push({ name: "saturated", run, kind: "saturated" });
      for (const fault of run.faults) rows.push({ name: fault.name, run, kind: "fault", fault });
      if (run.marks.length) rows.push({ name: "operator", run, kind: "marks" });
    }
    const element = document.getElementById("timeline");
    heading(element, "States, faults and requests", "a fault is light while it is present, dark while it is latched");
    const count = rows.length;
    const fitting = Math.floor((LEFT - 20) / 6.6);
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
              ctx.fillStyle = "#fff";
              ctx.fillText(text, left + 4 * ratio, top + high * part / 2);
            }
          };
          rows.forEach((row, i) => {
            if (row.kind === "state")
              for (const [begin, end, name, colour] of row.run.states) band(i, begin, end, colour, 0.8, name);
            else if (row.kind === "saturated")
              for (const [begin, end] of row.run.saturated) band(i, begin, end, "#e69f00", 0.6);
            else if (row.kind === "fault") {
              for (const [begin, end] of row.fault.present) band(i, begin, end, "#f0b48f", 0.8);
              for (const [begin, end] of row.fault.latched) band(i, begin, end, "#c44900", 0.4);
            } else {
              let free = -Infinity;
              ctx.fillStyle = INK;
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
    const options = common(element, 24 * count + 66);
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
    const u = new uPlot(options, [grid, grid.map(() => 0)], element);
    u.home = element;
    plots.push(u);
  }

  function phasePlot() {
    const element = document.getElementById("phase");
    if (!runs.some(r => r.phase.t.length)) return;
    heading(element, "Phase plot", "of the time shown above; the dot follows the cursor");
    const inside = (run, min, max) => {
      const x = [], y = [];
      for (let i = 0; i < run.phase.t.length; i++) {
        if (run.phase.t[i] >= min && run.phase.t[i] <= max) { x.push(run.phase.x[i]); y.push(run.phase.y[i]); }
      }
      return [x, y];
    };
    let ranges;
    const selected = (min, max) => {
      const parts = runs.map(run => inside(run, min, max));
      ranges = [0, 1].map(k => {
        let low = Infinity, high = -Infinity;
        for (const part of parts) for (const v of part[k]) { if (v < low) low = v; if (v > high) high = v; }
        if (!(low <= high)) [low, high] = [-1, 1];
        const margin = 0.05 * (high - low) || 1e-6;
        return [low - margin, high + margin];
      });
      return [null, ...parts];
    };
    const curve = (u, index) => {
      uPlot.orient(u, index, (series, xs, ys, sx, sy, toX, toY, left, top, wide, high) => {
        const { ctx, bbox } = u, [x, y] = u.data[index];
        ctx.save();
        ctx.beginPath(); ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height); ctx.clip();
        ctx.strokeStyle = runs[index - 1].colour;
        ctx.lineWidth = 0.8 * devicePixelRatio;
        ctx.beginPath();
        for (let i = 0; i < x.length; i++) {
          ctx.lineTo(toX(x[i], sx, wide, left), toY(y[i], sy, high, top));
        }
        ctx.stroke();
        ctx.restore();
      });
      return null;
    };
    const first = selected(...whole);
    const u = new uPlot({
      mode: 2, width: width(element), height: 420, cursor: { show: false }, legend: { show: several, live: false },
      scales: { x: { time: false, range: () => ranges[0] }, y: { range: () => ranges[1] } },
      series: [null, ...runs.map(run => ({ label: run.name, stroke: run.colour, paths: curve }))],
      axes: [axis("position error [mm]"), axis("velocity error [mm/s]", { size: 64 })],
    }, first, element);
    u.home = element;
    const dots = runs.map(run => {
      const dot = document.createElement("div");
      dot.style.cssText = "position:absolute;width:9px;height:9px;margin:-5px 0 0 -5px;border-radius:5px;display:none;"
        + `border:1px solid #fff;background:${several ? run.colour : "#d55e00"}`;
      u.over.append(dot);
      return dot;
    });
    phase = {
      plot: u,
      show(min, max) { u.setData(selected(min, max)); dots.forEach(dot => { dot.style.display = "none"; }); },
      point(t) {
        runs.forEach((run, k) => {
          const times = run.phase.t, dot = dots[k];
          let low = 0, high = times.length - 1;
          while (low < high) { const mid = (low + high) >> 1; if (times[mid] < t) low = mid + 1; else high = mid; }
          const x = run.phase.x[low], y = run.phase.y[low];
          const there = times.length && Math.abs(times[low] - t) < (whole[1] - whole[0]) / 200
            && x >= ranges[0][0] && x <= ranges[0][1] && y >= ranges[1][0] && y <= ranges[1][1];
          dot.style.display = there ? "block" : "none";
          if (there) { dot.style.left = u.valToPos(x, "x") + "px"; dot.style.top = u.valToPos(y, "y") + "px"; }
        });
      },
    };
  }

  timeline();
  const shown = data.figures.filter(f => runs.some(r => f.series.some(s => r.columns[s.column])));
  shown.forEach((figure, i) => over(figure, i === shown.length - 1));
  phasePlot();

  const everything = () => phase ? [...plots, phase.plot] : plots;
  const fit = to => {
    for (const u of everything()) {
      const wanted = Math.min(to || Infinity, width(u.home));
      if (u.width !== wanted) u.setSize({ width: wanted, height: u.height });
    }
  };
  let waiting = 0;
  addEventListener("resize", () => { cancelAnimationFrame(waiting); waiting = requestAnimationFrame(() => fit()); });
  // paper is narrower than most windows; what is drawn for it stays sharp
  addEventListener("beforeprint", () => {
    fit(660);
    for (const d of document.querySelectorAll("details")) { d.dataset.was = d.open; d.open = true; }
  });
  addEventListener("afterprint", () => {
    fit();
    for (const d of document.querySelectorAll("details")) d.open = d.dataset.was === "true";
  });
  document.documentElement.dataset.drawn = String(everything().length);
})();
