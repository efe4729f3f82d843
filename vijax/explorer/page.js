// Script of the page: it sends requests to the server and displays the server's messages, always as text.
window.vijax = (() => {
  let channel, pick, across, up, figure, axes, number = 0, sent = 0, state = {}, base = {};
  const id = (name) => document.getElementById(name);
  const all = (selector) => document.querySelectorAll(selector);
  const make = (tag, text, classes) => {
    const made = document.createElement(tag);
    if (text !== undefined) made.textContent = text;
    if (classes) made.className = classes;
    return made;
  };
  // The server does not notice a message that equals the last one, so messages are numbered.
  const send = (kind, content = {}) => { channel.request = { kind, sent: ++sent, ...content }; };
  const hide = (element, hidden) => { element.hidden = hidden; };

  // --- the pick ------------------------------------------------------------------------------------------------
  const cellAt = (axis, value) => {
    const { edges } = axis;
    let low = 0, high = edges.length - 2;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (edges[middle] <= value) low = middle; else high = middle - 1;
    }
    return low;
  };
  const choose = (column, row) => {
    const last = [axes.x.values.length - 1, axes.y.values.length - 1];
    column = Math.min(Math.max(column, 0), last[0]);
    row = Math.min(Math.max(row, 0), last[1]);
    if (state.pick && state.pick[0] === column && state.pick[1] === row) return;
    state.pick = [column, row];
    const x = axes.x.values[column], y = axes.y.values[row];
    pick.data = { x: [x], y: [y] };
    across.location = x;
    up.location = y;
    send("pick", { column, row, number: ++number });
  };
  // Events of the pointer: Bokeh waits 300 ms after a tap for a second one, and then reports one double tap.
  const pointed = (event) => {
    if (!axes || (event.type === "pointermove" && !(event.buttons & 1)) || event.button > 0) return;
    const { frame } = Bokeh.index.find_one(figure), box = id("map").getBoundingClientRect(), { bbox } = frame;
    const sx = event.clientX - box.left, sy = event.clientY - box.top;
    if (event.type === "pointerdown") {
      if (sx < bbox.left || sx > bbox.right || sy < bbox.top || sy > bbox.bottom) return;
      id("map").setPointerCapture(event.pointerId);
    }
    choose(cellAt(axes.x, frame.x_scale.invert(sx)), cellAt(axes.y, frame.y_scale.invert(sy)));
  };
  const keys = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  const pressed = (event) => {
    const step = keys[event.key];
    if (!step || !state.pick) return;
    event.preventDefault();
    const far = event.shiftKey ? 10 : 1;
    choose(state.pick[0] + far * step[0], state.pick[1] + far * step[1]);
  };

  // --- messages of the server -----------------------------------------------------------------------------------
  const options = (select, names) => select.replaceChildren(...names.map((name) => {
    const option = make("option", name.replaceAll("_", " "));
    option.value = name;
    return option;
  }));
  const slider = ({ name, label, low, high, value }) => {
    const row = make("div", undefined, "value");
    row.dataset.name = name;
    const title = make("label", label), range = make("input"), exact = make("input");
    Object.assign(range, { type: "range", id: `value-${name}`, min: low, max: high, step: "any", value });
    Object.assign(exact, { type: "number", min: low, max: high, step: "any", value: +(+value).toPrecision(6) });
    exact.setAttribute("aria-label", `${label}, exactly`);
    title.htmlFor = range.id;
    range.addEventListener("input", () => {
      exact.value = +(+range.value).toPrecision(6);
      send("value", { name, value: +exact.value, number: ++number });
    });
    exact.addEventListener("change", () => {
      const value = Number.isFinite(exact.valueAsNumber) ? exact.valueAsNumber : exact.value;
      send("value", { name, value, number: ++number });
    });
    row.append(title, range, exact);
    base[name] = value;
    return row;
  };
  // Marks that an answer is completely on the screen; benchmarks and tests wait for the mark.
  const answered = (request) => {
    requestAnimationFrame(() => requestAnimationFrame(() => { document.body.dataset.shown = request; }));
  };
  const table = (rows) => {
    const made = make("table"), head = make("tr"), body = make("tbody");
    rows[0].forEach((text) => { const heading = make("th", text); heading.scope = "col"; head.append(heading); });
    if (rows[0][0] === "") head.firstChild.append(make("span", "colour", "unseen"));
    rows.slice(1).forEach((row) => {
      const line = make("tr");
      row.forEach((text) => {
        const cell = make("td");
        if (/^#[0-9a-f]{6}$/.test(text)) {
          const sign = make("span", undefined, "sign");
          sign.style.background = text;
          cell.append(sign);
        } else cell.textContent = text;
        line.append(cell);
      });
      body.append(line);
    });
    const top = make("thead");
    top.append(head);
    made.append(top, body);
    return made;
  };
  const sections = {
    page({ title, variables, axes: mapAxes, sliders }) {
      axes = mapAxes;
      id("title").textContent = title;
      document.title = `vijax ${title}`;
      options(id("variable"), variables);
      options(id("along"), [axes.x.name, axes.y.name]);
      id("values").replaceChildren(...sliders.map(slider));
    },
    view(content) {
      state = content;
      id("variable").value = content.variable;
      id("scale").value = content.scale;
      id("curves").value = content.curves;
      id("along").value = content.along;
      id("follow").checked = content.follow;
      all(".value").forEach((row) => {
        const { name } = row.dataset, moved = name in content.values, value = moved ? content.values[name] : base[name];
        const [, range, exact] = row.children;
        row.classList.toggle("moved", moved);
        if (document.activeElement !== range) range.value = value;
        if (document.activeElement !== exact) exact.value = +(+value).toPrecision(6);
      });
      id("make").disabled = content.moved.length === 0;
      const token = new URLSearchParams(location.search).get("token");
      const query = new URLSearchParams(content.query);
      if (token) query.set("token", token);
      history.replaceState(null, "", `?${query}`);
    },
    legend({ title, entries }) {
      id("coloured").textContent = title;
      id("legend").replaceChildren(...entries.map(([sign, colour, text, count]) => {
        const line = make("li"), mark = make("span", { dot: "\u2022", cross: "\u00d7", star: "\u2605" }[sign] ?? "", `sign ${sign}`);
        if (sign === "cell") mark.style.background = colour;
        if (["dot", "cross", "star"].includes(sign)) mark.style.color = colour;
        line.append(mark, make("span", text), make("span", sign === "star" ? "" : count.toLocaleString("en"), "count"));
        return line;
      }));
    },
    curves({ text, entries, points }) {
      hide(id("curvechoice"), false);
      hide(id("overlay"), false);
      id("curvenote").textContent = text;
      hide(id("curvenote"), !text);
      id("curvelegend").replaceChildren(...entries.map(([colour, dashes, kind, count]) => {
        const line = make("li"), mark = make("span", undefined, "sign curve");
        let end = 0;
        const parts = dashes.map((length, index) => {
          const begin = end;
          end += 1.8 * length;
          return `${index % 2 ? "transparent" : colour} ${begin}px ${end}px`;
        });
        mark.style.background = parts.length ? `repeating-linear-gradient(90deg, ${parts.join(", ")})` : colour;
        line.append(mark, make("span", kind), make("span", count.toLocaleString("en"), "count"));
        return line;
      }));
      const [summary, place] = id("points").children;
      hide(id("points"), !points.length);
      summary.textContent = `Points of codimension 2: ${Math.max(points.length - 1, 0)}`;
      place.replaceChildren(...(points.length ? [table(points)] : []));
    },
    cell({ number: request, heading, rows, note }) {
      id("heading").textContent = heading;
      id("cellnote").textContent = note;
      hide(id("cellnote"), !note);
      id("rows").replaceChildren(...rows.map(([name, text]) => {
        const line = make("div");
        // A number is never broken at its sign.
        const value = make("dd");
        value.append(...text.split(/(?<=, )/).map((part) => make("span", part)));
        line.append(make("dt", name), value);
        return line;
      }));
      answered(request);
    },
    panel({ name, state: now, text, rows }) {
      const place = document.querySelector(`[data-panel="${name}"]`);
      place.replaceChildren();
      place.dataset.state = now;
      if (text) place.append(make("p", text, now));
      if (now === "running") place.append(make("progress"));
      if (rows.length) place.append(table(rows));
      if (name === "motion" && now === "failed") answered(number);
      if (now === "running" || now === "idle") files(name, false);
      if (now === "done") files(name, true);
      const button = document.querySelector(`.cancel[data-name="${name}"]`);
      if (button) hide(button, now !== "running");
      if (name === "plane" && now === "running") {
        const stop = make("button", "Cancel");
        stop.type = "button";
        stop.addEventListener("click", () => send("cancel", { name }));
        place.append(stop);
      }
    },
    progress({ name, done, total }) {
      const bar = document.querySelector(`[data-panel="${name}"] progress`);
      if (bar) Object.assign(bar, { value: done, max: total });
    },
    recipe({ name, command, python }) {
      const place = document.querySelector(`[data-recipe="${name}"]`);
      if (!place) return;
      hide(place, false);
      place.replaceChildren(place.firstElementChild, ...[command, python].filter(Boolean).map((text) => {
        const block = make("div"), copy = make("button", "Copy");
        copy.type = "button";
        copy.addEventListener("click", () => copied(text, copy));
        block.append(make("pre", text), copy);
        return block;
      }));
    },
    note({ text, error }) {
      id("note").textContent = text;
      id("note").classList.toggle("error", error);
      hide(id("note"), !text);
      if (error) answered(number);
    },
    compilation({ text }) {
      id("compilation").textContent = text;
      hide(id("compilation"), !text);
    },
    confirm({ text }) { if (window.confirm(text)) send("make", { confirmed: true }); },
    file({ name, content }) {
      const link = make("a");
      link.href = `data:application/octet-stream;base64,${content}`;
      link.download = name;
      link.click();
    },
  };
  const receive = (message) => sections[message.section]?.(message);
  const copied = async (text, button) => {
    await navigator.clipboard.writeText(text);
    const before = button.textContent;
    button.textContent = "Copied";
    setTimeout(() => { button.textContent = before; }, 1500);
  };
  const files = (name, shown) => {
    const place = document.querySelector(`.files[data-export="${name}"]`);
    if (!place) return;
    place.replaceChildren(...(shown ? ["pdf", "svg", "png"] : []).map((format) => {
      const button = make("button", format.toUpperCase());
      button.type = "button";
      button.setAttribute("aria-label", `Save the picture of this ${name} as ${format.toUpperCase()}`);
      button.addEventListener("click", () => send("export", { panel: name, format }));
      return button;
    }));
  };

  // --- the server ----------------------------------------------------------------------------------------------
  const lost = () => {
    hide(id("lost"), false);
    // With a token, the page itself is fetched, as a new server has a new token; otherwise a file, which makes no page.
    const url = new URLSearchParams(location.search).has("token") ? location.href : "static/js/bokeh.min.js";
    const again = setInterval(async () => {
      try {
        const answer = await fetch(url, { cache: "no-store" });
        if (answer.ok) { clearInterval(again); location.reload(); }
      } catch { /* not yet */ }
    }, 1000);
  };
  const begin = (models) => {
    ({ channel, pick, across, up, map: figure } = models);
    id("map").addEventListener("keydown", pressed);
    id("map").addEventListener("pointerdown", pointed);
    id("map").addEventListener("pointermove", pointed);
    id("variable").addEventListener("change", colour);
    id("scale").addEventListener("change", colour);
    id("curves").addEventListener("change", colour);
    id("along").addEventListener("change", () => send("along", { along: id("along").value }));
    id("follow").addEventListener("change", () => send("follow", { follow: id("follow").checked, number: ++number }));
    id("make").addEventListener("click", () => send("make"));
    id("reset").addEventListener("click", () => Object.keys(state.values).forEach((name) => send("value", { name, number: ++number })));
    id("link").addEventListener("click", () => copied(location.href, id("link")));
    all(".compute").forEach((button) => button.addEventListener("click", () => send("open", { name: button.dataset.name })));
    all(".cancel").forEach((button) => button.addEventListener("click", () => send("cancel", { name: button.dataset.name })));
    ["map", "motion"].forEach((name) => files(name, true));
    send("ready");
  };
  const colour = () => send("colour", { variable: id("variable").value, scale: id("scale").value, curves: id("curves").value });
  return { begin, receive, lost, get number() { return number; } };
})();
