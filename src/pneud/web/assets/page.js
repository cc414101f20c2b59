"use strict";
(() => {
  const at = id => document.getElementById(id);
  const KEY = "pneud-key", AGAIN_MS = 1000, JOG_MS = 100, SHOWN_S = 10;

  // the door: what came behind # goes into the page's own store, and out of the address

  const store = { get: () => sessionStorage.getItem(KEY) || "", set: key => sessionStorage.setItem(KEY, key) };
  async function enter(secret) {
    const answer = await fetch("session", {
      method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ secret }),
    });
    if (!answer.ok) throw new Error((await answer.text()).replace("pneud: ", ""));
    store.set((await answer.json()).key);
  }
  at("entry").addEventListener("submit", async event => {
    event.preventDefault();
    try {
      await enter(at("secret").value);
      at("secret").value = ""; at("enter").hidden = true;
      connect();
    } catch (e) { tell(e.message); }
  });

  // words

  let quiet = 0;
  function tell(words) {
    const message = at("message");
    message.textContent = words; message.hidden = !words;
    clearTimeout(quiet);
    if (words) quiet = setTimeout(() => { message.hidden = true; }, 8000);
  }
  const set = (id, text) => { const e = at(id); if (e.textContent !== text) e.textContent = text; };
  let said = "", saidAt = 0;
  function speak(words) {  // for those who hear the page: without numbers that change all the time
    const plain = words.replace(/[-−+]?\d+(\.\d+)?/g, "").replace(/\s+/g, " ");
    if (plain === said || Date.now() < saidAt + 1000) return;
    said = plain; saidAt = Date.now();
    at("spoken").textContent = words;
  }

  // the line

  let line = null, number = 0, operates = false, lastPicture = 0, pictures = 0;
  const asked = new Map();
  function connect() {
    if (line) { line.onclose = null; line.close(); }
    const mine = line = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live${location.search}`);
    let open = false;
    mine.onopen = () => { open = true; asked.clear(); mine.send(JSON.stringify({ hello: store.get() })); };
    mine.onmessage = event => {
      const message = JSON.parse(event.data);
      if ("picture" in message) {
        if (++pictures % 2) mine.send(JSON.stringify({ seen: message.picture }));  // and the one before
        lastPicture = performance.now();
        document.body.classList.remove("alone");
        show(message);
      } else if ("status" in message) facts(message.status);
      else if ("welcome" in message) welcome(message);
      else if ("reply" in message) replied(message);
    };
    mine.onclose = () => {
      if (line !== mine) return;
      line = null;
      release();
      alone(open);
      setTimeout(connect, AGAIN_MS);
    };
  }
  function alone(wasThere) {
    document.body.classList.add("alone");
    banner({ level: "bad", words: "no connection to pneud web: all below is old",
      then: wasThere ? "what this page has set going is held; it is looked for again" : "it is looked for again", faults: [] });
    if (!wasThere) locked();
  }
  async function locked() {  // refused, or not there?
    try {
      const answer = await fetch("logs");
      if (answer.status === 401) { at("enter").hidden = false; set("words", "the password is needed to look"); set("then", ""); }
    } catch { /* not there */ }
  }
  function welcome({ welcome, message }) {
    operates = welcome;
    document.body.classList.toggle("operates", operates);
    for (const id of ["controls", "stop", "tuning"]) at(id).hidden = !operates;
    if (operates) at("enter").hidden = true;
    else if (store.get()) { store.set(""); at("enter").hidden = false; tell("this link is of another run of pneud web: it only looks now"); }
    if (message) tell(message);
    if (operates) read();
    at("going").hidden = !operates;
    programs();
  }
  function ask(verb, fields, then) {
    if (!line || line.readyState !== WebSocket.OPEN) {
      if (operates) tell(verb === "stop" ? "NO CONNECTION: the stop has not been sent; use the emergency stop" : "no connection");
      return;
    }
    number = number % 1e6 + 1;
    if (then) asked.set(number, then);
    if (asked.size > 100) asked.delete(asked.keys().next().value);
    line.send(JSON.stringify({ do: verb, id: number, ...fields }));
  }
  function replied(message) {
    const then = asked.get(message.reply);
    asked.delete(message.reply);
    if (!message.ok) tell(message.message);
    if (then) then(message);
  }

  // what is seen

  const NUMBERS = { position_mm: 3, reference_mm: 3, error_mm: 3, velocity_mm_s: 1, p1_bar: 2, p2_bar: 2, supply_bar: 2, command_v: 3 };
  function banner({ level, words, then, faults }) {
    const box = at("banner");
    if (box.className !== level) box.className = level;
    set("words", words); set("then", then);
    const names = faults.map(f => f[0]).join(", ");
    set("faults", names); at("faults").hidden = !names;
    speak(then ? `${words}. ${then}` : words);
  }
  let limits = null, shownNumbers = 0;
  function show(picture) {
    banner(picture);
    const state = at("state");
    set("state", picture.state + (picture.in_position ? ", in position" : ""));
    if (state.className !== `badge ${picture.level}`) state.className = `badge ${picture.level}`;
    if (performance.now() > shownNumbers + 90) {  // a person reads ten a second at most
      shownNumbers = performance.now();
      for (const [name, digits] of Object.entries(NUMBERS)) {
        const value = picture[name];
        set(name, value == null ? "–" : value.toFixed(digits).replace("-", "−"));
      }
    }
    draw(picture.curves);
  }
  let shownChoice = "";
  function choose(names, name) {  // the axes of the daemon; a link each, so that the way back leads back
    const found = names.length > 1 ? [name, ...names].join(" ") : "";
    if (found === shownChoice) return;
    shownChoice = found;
    at("choice").hidden = !found;
    at("choice").replaceChildren(...(found ? names : []).map(one => {
      const link = document.createElement("a");
      link.href = `?axis=${encodeURIComponent(one)}`; link.textContent = one;
      if (one === name) link.setAttribute("aria-current", "page");
      return link;
    }));
  }
  function facts(status) {
    if (!status.name) return;
    choose(status.choice, status.name);
    set("name", status.name); document.title = `${status.name} – pneud`;
    set("where", `${status.bus}, ${status.rate_hz} Hz`);
    limits = status.limits;
    if (limits) set("travel", `${limits.min_mm.toFixed(0)} … ${limits.max_mm.toFixed(0)} mm, at most ${limits.speed_mm_s.toFixed(0)} mm/s`);
    set("done", status.done ? `in its life: ${status.done}` : "");
    const p = status.program;
    set("program", !p ? "none under way" : `${p.name || "a program"}: ${p.stage.replace("_", " ")}, record ${p.record}`
      + (p.of ? ` of ${p.of}` : "") + (p.words ? ` (${p.words})` : "") + `, ${p.cycle} cycle${p.cycle === 1 ? "" : "s"} done`);
    at("resume").hidden = !(p && p.stage === "stopped");
    set("who", status.lease ? `commanded by process ${status.lease.pid} of user ${status.lease.uid}` : "nobody commands");
  }

  // curves

  const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const FIGURES = [
    ["Error [mm]", [["error_mm", "reference − position", 1]], 0.05],
    ["Position [mm]", [["position_mm", "position", 1], ["reference_mm", "reference", 2]], 1],
    ["Pressures, absolute [bar]", [["p1_bar", "p1", 1], ["p2_bar", "p2", 2], ["supply_bar", "supply", 3]], 0.2],
    ["Valve [V]", [["command_v", "command", 1]], 0.2],
  ];
  const SIGNALS = FIGURES.flatMap(f => f[1].map(s => s[0]));
  const kept = { t: [] };
  for (const name of SIGNALS) kept[name] = [];
  const plots = [];
  const numbers = (u, splits, index, space, step) => {
    const decimals = step >= 1e-6 ? (String(step).split(".")[1] || "").length : 6;
    return splits.map(v => v == null ? "" : v.toFixed(decimals).replace("-", "−"));
  };
  const axis = extra => ({ stroke: () => css("--soft"), font: "12px system-ui, sans-serif",
    grid: { stroke: () => css("--grid"), width: 1 }, ticks: { stroke: () => css("--grid"), width: 1 }, ...extra });
  function figures() {
    for (const [title, lines, least] of FIGURES) {
      const home = document.createElement("div"), h = document.createElement("h3");
      home.className = "plot"; h.textContent = title;
      for (const [, label, colour] of lines) {
        const key = document.createElement("span"), mark = document.createElement("i");
        mark.className = `c${colour}`; key.append(mark, label); h.append(key);
      }
      home.append(h); at("curves").append(home);
      const spread = (u, min, max) => {
        if (min == null) return [0, 1];
        const room = Math.max(0, least - (max - min)) / 2 + 0.06 * (max - min);
        return [min - room, max + room];
      };
      const plot = new uPlot({
        width: Math.max(240, home.clientWidth), height: 170, cursor: { show: false }, legend: { show: false },
        scales: { x: { time: false, range: (u, min, max) => [max - SHOWN_S, max] }, y: { range: spread } },
        series: [{}, ...lines.map(([, , colour]) => ({ stroke: () => css(`--c${colour}`), width: 1.5, points: { show: false }, spanGaps: false }))],
        axes: [axis({ size: 28, values: (u, splits) => splits.map(v => { const s = Math.round(v - u.scales.x.max); return s > -SHOWN_S - 0.5 ? `${s} s`.replace("-", "−") : ""; }),
          splits: u => { const found = []; for (let s = -SHOWN_S; s <= 0; s += 2) found.push(u.scales.x.max + s); return found; } }),
          axis({ size: 58, values: numbers })],
      }, [[], ...lines.map(() => [])], home);
      plot.root.setAttribute("role", "img");
      plot.root.setAttribute("aria-label", `${title}: ${lines.map(l => l[1]).join(", ")}; the numbers are above`);
      plots.push([plot, lines.map(l => l[0]), home]);
    }
  }
  let due = 0;
  function draw(curves) {
    if (!curves.t.length) return;
    const t = kept.t, last = t.length ? t[t.length - 1] : -Infinity;
    if (curves.t[0] < last || curves.t[0] > last + 60)  // another daemon
      for (const name of ["t", ...SIGNALS]) kept[name].length = 0;
    else if (curves.t[0] > last + 0.1) { t.push(last + 0.01); for (const name of SIGNALS) kept[name].push(null); }
    for (const name of ["t", ...SIGNALS]) for (const v of curves[name]) kept[name].push(v);
    let old = 0;
    while (t[old] < t[t.length - 1] - SHOWN_S - 0.5) old++;
    if (old) for (const name of ["t", ...SIGNALS]) kept[name].splice(0, old);
    if (!due) due = requestAnimationFrame(() => {
      due = 0;
      for (const [plot, names] of plots) plot.setData([kept.t, ...names.map(name => kept[name])]);
    });
  }
  addEventListener("resize", () => { for (const [plot, , home] of plots) plot.setSize({ width: Math.max(240, home.clientWidth), height: 170 }); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { for (const [plot] of plots) plot.redraw(false, true); });

  // what is done

  const stop = () => { release(true); ask("stop"); };
  at("stop").addEventListener("pointerdown", event => { event.preventDefault(); stop(); });
  at("stop").addEventListener("click", event => { if (event.detail === 0) stop(); });  // by keys, or a screen reader
  for (const button of document.querySelectorAll("[data-do]")) button.addEventListener("click", () => {
    const act = () => ask(button.dataset.do, {});
    if (button.dataset.asks) sure(button.dataset.asks, act); else act();
  });
  let act = null;
  function sure(question, then) {
    act = then;
    set("question", question);
    at("sure").show();  // not modal: STOP stays in reach
    at("no").focus();
  }
  at("yes").addEventListener("click", () => { at("sure").close(); if (act) act(); });
  at("no").addEventListener("click", () => at("sure").close());
  at("sure").addEventListener("close", () => { setTimeout(() => { act = null; }); });

  const millimetres = input => Number(input.value.trim().replace(",", ".").replace("−", "-"));
  at("goto").addEventListener("submit", event => {
    event.preventDefault();
    const x_mm = millimetres(at("x")), speed = at("speed").value.trim();
    if (!Number.isFinite(x_mm) || (speed && !(millimetres(at("speed")) > 0))) { tell("go to: a position in mm and, where you like, a speed in mm/s"); return; }
    ask("goto", speed ? { x_mm, speed_mm_s: millimetres(at("speed")) } : { x_mm });
  });

  let jogging = 0;
  function jog(button) {
    if (jogging || !operates) return;
    const velocity_mm_s = Number(button.dataset.jog) * Number(at("jogspeed").value);
    const move = () => ask("jog", { velocity_mm_s }, reply => { if (!reply.ok) release(true); });
    button.classList.add("held");
    jogging = setInterval(move, JOG_MS);
    move();
  }
  function release(stopped) {
    if (!jogging) return;
    clearInterval(jogging); jogging = 0;
    for (const b of document.querySelectorAll(".jog")) b.classList.remove("held");
    if (stopped !== true) ask("hold");
  }
  for (const button of document.querySelectorAll(".jog")) {
    button.addEventListener("pointerdown", event => { if (event.button === 0) { button.setPointerCapture(event.pointerId); jog(button); } });
    for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) button.addEventListener(kind, () => release());
    button.addEventListener("contextmenu", event => event.preventDefault());
    button.addEventListener("keydown", event => { if (event.key === "Enter") { event.preventDefault(); if (!event.repeat) jog(button); } });
    button.addEventListener("keyup", event => { if (event.key === "Enter") release(); });
    button.addEventListener("blur", () => release());
  }
  addEventListener("blur", () => release());
  document.addEventListener("visibilitychange", () => { if (document.hidden) release(); });

  // keys, as on the screen of pneud top
  const LETTERS = { a: "arm", d: "disarm", c: "clear", h: "hold", t: "track", r: "home" };
  at("keys").checked = localStorage.getItem("pneud-keys") !== "off";
  at("keys").addEventListener("change", () => localStorage.setItem("pneud-keys", at("keys").checked ? "on" : "off"));
  const writes = e => e.matches && e.matches("input:not([type=checkbox]), select, textarea");
  addEventListener("keydown", event => {
    if (!operates || event.ctrlKey || event.altKey || event.metaKey) return;
    if (event.key === "Escape" || (event.key === " " && !writes(event.target))) {
      event.preventDefault();
      if (!event.repeat) stop();
      if (at("sure").open) at("sure").close();
      return;
    }
    if (!at("keys").checked || writes(event.target) || at("sure").open) return;
    if (event.key === "ArrowLeft" || event.key === "ArrowRight") {
      event.preventDefault();
      if (!event.repeat) jog(at(event.key === "ArrowLeft" ? "back" : "forth"));
    } else if (event.key === "g") { event.preventDefault(); at("x").focus(); at("x").select(); }
    else if (LETTERS[event.key] && !event.repeat) document.querySelector(`[data-do=${LETTERS[event.key]}]`).click();
  }, true);
  addEventListener("keyup", event => { if (event.key === "ArrowLeft" || event.key === "ArrowRight") release(); });
  addEventListener("keyup", event => { if (event.key === " " && operates && !writes(event.target)) event.preventDefault(); }, true);

  // tuning

  function read() {
    ask("tune_get", {}, reply => {
      if (!reply.ok) return;
      at("gains").replaceChildren(...Object.entries(reply.gains).filter(([, v]) => typeof v === "number").map(([name, value]) => {
        const label = document.createElement("label"), input = document.createElement("input");
        input.value = input.dataset.was = String(value); input.name = name; input.inputMode = "decimal"; input.autocomplete = "off";
        input.addEventListener("input", () => label.classList.toggle("changed", input.value !== input.dataset.was));
        label.append(name, input);
        return label;
      }));
    });
  }
  at("fetch").addEventListener("click", read);
  at("tune").addEventListener("submit", event => {
    event.preventDefault();
    const gains = {};
    for (const input of at("gains").querySelectorAll("input")) if (input.value !== input.dataset.was) gains[input.name] = millimetres(input);
    if (!Object.keys(gains).length) { tell("nothing has changed"); return; }
    if (Object.values(gains).some(v => !Number.isFinite(v))) { tell("gains are numbers"); return; }
    ask("tune_set", { gains }, reply => { if (reply.ok) { tell(`set: ${reply.changed}`); read(); } });
  });

  // programs

  async function programs() {
    const answer = await fetch("programs");
    if (!answer.ok) return;
    const found = (await answer.json()).programs;
    at("programs").hidden = !found.length;
    at("listed").replaceChildren(...found.map(one => {
      const row = document.createElement("tr"), run = document.createElement("button");
      run.textContent = "Run"; run.ariaLabel = `run ${one.title}`; run.disabled = !operates || Boolean(one.trouble);
      run.addEventListener("click", () => {
        const cycles = Number(at("cycles").value.trim());
        if (!Number.isInteger(cycles) || cycles < 0) { tell("so often: a whole number; 0 until it is stopped"); return; }
        ask("run", { program: one.name, cycles });
      });
      for (const content of [one.title, one.trouble || String(one.records), `${one.name}.toml`, run]) {
        const cell = document.createElement("td");
        cell.append(content); row.append(cell);
      }
      return row;
    }));
  }
  at("programs").addEventListener("toggle", () => { if (at("programs").open) programs(); });
  at("resume").addEventListener("click", () => ask("run", {}));

  // logs

  const size = bytes => bytes < 1e6 ? `${(bytes / 1e3).toFixed(0)} kB` : `${(bytes / 1e6).toFixed(1)} MB`;
  async function logs() {
    const answer = await fetch(`logs${location.search}`);
    if (!answer.ok) { tell("the logs cannot be listed"); return; }
    const found = (await answer.json()).logs;
    at("logs").replaceChildren(...found.map(log => {
      const row = document.createElement("tr"), link = document.createElement("a");
      link.href = `reports/${encodeURIComponent(log.name)}`; link.target = "_blank"; link.rel = "noopener";
      link.textContent = "report"; link.ariaLabel = `report on ${log.name}`;
      const began = log.start ? new Date(1e3 * log.start).toLocaleString() : "–";
      for (const content of [began, link, `${log.length_s.toFixed(1)} s${log.closed ? "" : ", goes on, or was cut short"}`, size(log.bytes), log.name]) {
        const cell = document.createElement("td");
        cell.append(content); row.append(cell);
      }
      return row;
    }));
    at("nologs").hidden = found.length > 0; set("nologs", "no logs that this page may read");
  }
  at("logbook").addEventListener("toggle", () => { if (at("logbook").open) logs(); });

  // a connection that says nothing is none
  setInterval(() => { if (line && lastPicture && performance.now() > lastPicture + 1500) alone(true); }, 250);

  figures();
  const token = location.hash.slice(1);
  if (token) {
    history.replaceState(null, "", location.pathname + location.search);
    enter(token).catch(e => tell(e.message)).finally(connect);
  } else connect();
})();
