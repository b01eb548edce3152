"use strict";
(() => {
  const root = document.documentElement;
  const $ = (id) => document.getElementById(id);
  const colour = (name) => getComputedStyle(root).getPropertyValue(`--${name}`).trim();
  const plots = [];

  document.addEventListener("theme", () => plots.forEach((plot) => plot.redraw(false, true)));

  if ($("copy")) {
    $("copy").addEventListener("click", async () => {
      const range = document.createRange();
      range.selectNodeContents($("command"));
      getSelection().removeAllRanges();
      getSelection().addRange(range);
      try { await navigator.clipboard.writeText($("command").textContent); } catch { document.execCommand("copy"); }
      $("copy").textContent = "Copied";
    });
  }

  const { run, objects } = JSON.parse($("data").textContent);
  if (!run.x) return;
  const { x, series } = run;
  const count = x.length;
  const frameOf = (i) => (run.frame ? run.frame[i] : run.firstFrame + i);
  const degrees = series.steer_rad.some((value) => value !== null);
  const shown = {
    ...series,
    steer: degrees ? series.steer_rad.map((v) => (v === null ? null : (v * 180) / Math.PI)) : series.steer,
    charged: series.charged.map((v) => (v === null ? null : 100 * v)),
    matched: series.matched.map((v) => (v === null ? null : 100 * v)),
  };
  const digits = { steer: degrees ? 1 : 3, depth_m: 2, nearest_m: 2, charged: 1, matched: 1 };
  const heading = document.querySelector('[data-live="steer"]');
  if (heading && !degrees) heading.previousSibling.textContent = "share of half the width, + = left ";

  const indexAt = (value) => {  // the row nearest to a place on the axis
    let low = 0, high = count - 1;
    while (low < high) { const middle = (low + high) >> 1; if (x[middle] < value) low = middle + 1; else high = middle; }
    return low > 0 && value - x[low - 1] <= x[low] - value ? low - 1 : low;
  };

  // Videos in step: the first one that plays leads.
  let videos = [...document.querySelectorAll("video")];
  const leader = () => videos[0];
  let now = 0;

  const show = (i) => {
    now = Math.max(0, Math.min(count - 1, i));
    $("slider").value = now;
    const time = run.timed ? `${x[now].toFixed(2)} s · ` : "";
    const status = run.statuses[run.status[now]];
    const text = `${time}frame ${frameOf(now)} · ${status}${status === "blind" ? ": no heading" : ""}`;
    $("clock").textContent = text;
    $("slider").setAttribute("aria-valuetext", text);
    tell(now);
    plots.forEach((plot) => plot.moveHead());
  };
  const tell = (i) => {
    for (const output of document.querySelectorAll("[data-live]")) {
      const value = shown[output.dataset.live][i];
      output.textContent = value === null ? "–" : value.toFixed(digits[output.dataset.live]);
    }
  };
  const step = count > 1 ? (x[count - 1] - x[0]) / (count - 1) : 0.04;
  const seek = (i) => {
    show(i);
    // A little after the frame begins: at its very begin a player may still show the one before.
    for (const video of videos) video.currentTime = x[now] + Math.min(step / 4, 0.004);
  };
  const playing = () => leader() && !leader().paused && !leader().ended;
  const play = () => {
    if (!leader()) return;
    if (playing()) { videos.forEach((video) => video.pause()); return; }
    if (now >= count - 1) seek(0);
    videos.forEach((video) => { video.playbackRate = +$("speed").value; video.play().catch(() => {}); });
  };
  const follow = (time) => { if (playing()) show(indexAt(time)); };
  const lead = () => {
    const video = leader();
    $("play").disabled = !video;
    if (!video) { $("hint").textContent = $("hint").dataset.still + $("hint").textContent.replace("Space plays; ", " "); return; }
    if (video.requestVideoFrameCallback) {
      const next = (_, frame) => { follow(frame.mediaTime); if (video === leader()) video.requestVideoFrameCallback(next); };
      video.requestVideoFrameCallback(next);
    }
    video.ontimeupdate = () => {
      if (video !== leader()) return;
      if (!video.requestVideoFrameCallback) follow(video.currentTime);
      for (const other of videos.slice(1)) {
        if (Math.abs(other.currentTime - video.currentTime) > 0.08) other.currentTime = video.currentTime;
      }
    };
    const label = () => {
      $("play").textContent = playing() ? "❚❚" : "▶";
      $("play").setAttribute("aria-label", playing() ? "Pause" : "Play");
    };
    video.onplay = video.onpause = label;
    // A busy browser may leave the last frame out.
    video.onended = () => { if (video === leader()) show(indexAt(video.currentTime)); label(); };
  };
  for (const video of videos) {
    video.addEventListener("error", () => {
      const led = leader() === video;
      videos = videos.filter((each) => each !== video);
      video.closest("figure").querySelector(".what").textContent = "one frame: the video is not beside this page";
      if (led) lead();
    });
    video.closest(".screen").addEventListener("click", play);
  }
  lead();
  $("play").addEventListener("click", play);
  $("speed").addEventListener("change", () => videos.forEach((video) => { video.playbackRate = +$("speed").value; }));
  $("slider").addEventListener("input", () => seek(+$("slider").value));
  document.querySelectorAll("[data-frame]").forEach((button) => button.addEventListener("click", () => {
    const frame = +button.dataset.frame;
    let i = 0;
    while (i < count - 1 && frameOf(i) < frame) i += 1;
    seek(i);
  }));
  document.addEventListener("keydown", (event) => {
    if (event.target.closest("button, select, summary, input, a, pre") || event.ctrlKey || event.metaKey || event.altKey) return;
    const second = Math.max(1, Math.round(1 / step));
    const moves = { ArrowLeft: event.shiftKey ? -second : -1, ArrowRight: event.shiftKey ? second : 1, Home: -count, End: count };
    if (event.key === " ") play();
    else if (event.key in moves) { if (playing()) play(); seek(now + moves[event.key]); } else return;
    event.preventDefault();
  });

  // Plots share one axis, cursor and zoom.
  const axisLabel = (u, values) => values.map((v) => {
    if (run.timed) return `${+v.toFixed(3)} s`;
    const frame = v / run.frameS;
    return Math.abs(frame - Math.round(frame)) < 0.01 ? `${Math.round(frame)}` : "";
  });
  const lonely = (values) => values.flatMap((v, i) => (v !== null && (values[i - 1] ?? null) === null && (values[i + 1] ?? null) === null ? [i] : []));
  const axes = (values, space) => [
    { stroke: () => colour("muted"), grid: { stroke: () => colour("grid"), width: 1 }, ticks: { show: false }, values: axisLabel, size: 32, gap: 8, font: "11px system-ui, sans-serif" },
    { stroke: () => colour("muted"), grid: { stroke: () => colour("grid"), width: 1 }, ticks: { show: false }, values, space, size: 66, gap: 6, font: "11px system-ui, sans-serif" },
  ];
  const line = (name, fill) => {
    const alone = lonely(shown[name]);
    return {
      stroke: () => colour(name === "depth_m" ? "ahead" : name === "nearest_m" ? "nearest" : name === "steer" ? "heading" : name),
      width: 1.5, fill,
      points: { show: alone.length > 0, size: 3, width: 0, fill: () => colour(name === "depth_m" ? "ahead" : name === "nearest_m" ? "nearest" : "heading"), filter: (u, index, on) => (on ? alone : null) },
    };
  };
  let zooming = false;
  const add = (id, height, more, data, describe) => {
    const home = $(id);
    if (!home) return;
    let pressed = null;
    const head = document.createElement("div");
    head.className = "playhead";
    const plot = new uPlot({
      width: home.clientWidth, height, legend: { show: false }, padding: [8, 18, 0, 0],
      scales: { x: { time: false }, ...more.scales },
      cursor: { sync: { key: "run" }, drag: { x: true, y: false, setScale: true }, y: false, points: { size: 6 } },
      series: [{}, ...more.series], axes: axes(more.values, more.space),
      hooks: {
        ...more.hooks,
        setScale: [(u, key) => {
          if (key !== "x" || zooming) return;
          zooming = true;
          const { min, max } = u.scales.x;
          plots.forEach((other) => { if (other !== u) other.setScale("x", { min, max }); });
          zooming = false;
          plots.forEach((other) => other.moveHead());
        }],
        setCursor: [(u) => { if (u.cursor.event) tell(u.cursor.idx ?? now); }],
      },
    }, [x, ...data], home);
    plot.moveHead = () => {
      const left = plot.valToPos(x[now], "x");
      head.style.transform = `translateX(${left - 1}px)`;
      head.hidden = left < 0 || left > plot.over.clientWidth;
    };
    plot.over.append(head);
    plot.over.addEventListener("mousedown", (event) => { pressed = event.clientX; });
    plot.over.addEventListener("click", (event) => {
      if (pressed !== null && Math.abs(event.clientX - pressed) > 4) return;
      seek(indexAt(plot.posToVal(event.clientX - plot.over.getBoundingClientRect().left, "x")));
    });
    plot.over.addEventListener("mouseleave", () => tell(now));
    home.setAttribute("role", "img");
    home.setAttribute("aria-label", describe);
    plots.push(plot);
    new ResizeObserver(() => { plot.setSize({ width: home.clientWidth, height }); plot.moveHead(); }).observe(home);
  };
  const span = (name, unit) => {
    const known = shown[name].filter((v) => v !== null);
    if (!known.length) return `${unit} unknown`;
    return `${Math.min(...extremes(known)).toFixed(digits[name])} to ${Math.max(...extremes(known)).toFixed(digits[name])} ${unit}`;
  };
  const extremes = (values) => values.reduce(([low, high], v) => [Math.min(low, v), Math.max(high, v)], [Infinity, -Infinity]);

  // Status as bands behind the heading, and as a solid strip at the foot of the plot.
  const bands = (u) => {
    const { ctx, bbox } = u;
    const ratio = devicePixelRatio;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    for (let i = 0; i < count;) {
      let end = i + 1;
      while (end < count && run.status[end] === run.status[i]) end += 1;
      const left = u.valToPos(x[i], "x", true);
      const right = u.valToPos(end < count ? x[end] : x[count - 1] + step, "x", true);
      const name = run.statuses[run.status[i]];
      ctx.fillStyle = colour(`status-${name}`) || colour("muted");
      ctx.globalAlpha = name === "ok" ? 0 : 0.16;
      ctx.fillRect(left, bbox.top, right - left, bbox.height);
      ctx.globalAlpha = 1;
      ctx.fillRect(left, bbox.top + bbox.height - 4 * ratio, right - left, 4 * ratio);
      i = end;
    }
    ctx.restore();
  };
  const reach = degrees ? 10 : 0.2;
  add("plot-heading", 156, {
    series: [line("steer")],
    values: (u, ticks) => ticks.map((v) => (v === 0 ? "0" : `${Math.abs(v)}${degrees ? "°" : ""} ${v > 0 ? "left" : "right"}`)),
    space: 26,
    scales: { y: { range: (u, low, high) => { const most = 1.15 * Math.max(reach, Math.abs(low ?? 0), Math.abs(high ?? 0)); return [-most, most]; } } },
    hooks: { drawClear: [bands] },
  }, [shown.steer], `Heading over time: ${span("steer", degrees ? "degrees, positive is left" : "of half the width, positive is left")}`);
  add("plot-depth", 156, {
    series: [line("depth_m"), line("nearest_m")],
    values: (u, ticks) => ticks.map((v) => `${+v.toFixed(3)} m`), space: 28,
    scales: { y: { range: (u, low, high) => [0, 1.1 * (high || 1)] } },
  }, [shown.depth_m, shown.nearest_m], `Over time: depth ahead ${span("depth_m", "m")}, nearest ${span("nearest_m", "m")}`);
  add("plot-shares", 136, {
    series: [line("charged"), line("matched")],
    values: (u, ticks) => ticks.map((v) => `${+v.toFixed(2)} %`), space: 28,
    scales: { y: { range: (u, low, high) => [0, Math.min(100, 1.15 * (high || 1)) ] } },
  }, [shown.charged, shown.matched], `Over time: charged ${span("charged", "%")}, matched ${span("matched", "%")} of the image`);

  if (objects && objects.total) {
    const rows = objects.shown.length;
    const names = ["soon", "later", "hardly"];
    const bars = (u) => {
      const { ctx, bbox } = u;
      const ratio = devicePixelRatio;
      const tall = Math.min(14 * ratio, (0.7 * bbox.height) / rows);
      ctx.save();
      ctx.beginPath();
      ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
      ctx.clip();
      ctx.font = `${11 * ratio}px system-ui, sans-serif`;
      ctx.textBaseline = "middle";
      ctx.textAlign = "left";
      objects.shown.forEach((track, row) => {
        const middle = u.valToPos(rows - row - 0.5, "y", true);
        let right = 0;
        for (const [begin, end, level, kind] of track.spans) {  // kind 1: by itself, 2: shadow
          const high = kind ? tall : Math.max(tall / 3, 2 * ratio);
          const left = u.valToPos(begin, "x", true);
          right = u.valToPos(end, "x", true);
          const bar = [left, middle - high / 2, Math.max(right - left, ratio), high];
          ctx.fillStyle = colour(names[level]);
          ctx.globalAlpha = kind === 2 ? 0.3 : 1;
          ctx.fillRect(...bar);
          ctx.globalAlpha = 1;
          if (kind === 2) {
            ctx.strokeStyle = colour(names[level]);
            ctx.lineWidth = ratio;
            ctx.strokeRect(...bar);
          }
        }
        if (track.contact === null) return;
        const text = `${track.contact.toFixed(1)} s`;
        const wide = ctx.measureText(text).width + 6 * ratio;
        const first = u.valToPos(track.spans[0][0], "x", true);
        ctx.fillStyle = colour("text");
        ctx.fillText(text, right + wide < bbox.left + bbox.width ? right + 4 * ratio : Math.max(first - wide, bbox.left), middle);
      });
      ctx.restore();
    };
    add("plot-objects", 46 + 18 * rows, {
      series: [{ show: true, paths: () => null, points: { show: false } }],
      values: (u, ticks) => ticks.map((v) => (v % 1 ? `${objects.shown[rows - v - 0.5]?.id ?? ""}` : "")),
      space: 10,
      scales: { y: { range: [0, rows] } },
      hooks: { draw: [bars] },
    }, [x.map(() => null)], `Moving objects as bars over time: ${objects.total} in all; the table below has their figures`);
    const plot = plots[plots.length - 1];
    plot.axes[1].splits = () => objects.shown.map((_, row) => rows - row - 0.5).reverse();
    plot.axes[1].grid.show = false;
    plot.redraw(false, true);
  }
  seek(run.begin);  // the frame of the posters
})();
