"use strict";
// Tabs, and the slider of the held-out views. Without this script every section is shown in a row.

function tabs() {
  const buttons = [...document.querySelectorAll("[role=tab]")];
  const open = (button, focus) => {
    for (const one of buttons) {
      const chosen = one === button;
      one.setAttribute("aria-selected", String(chosen));
      one.tabIndex = chosen ? 0 : -1;
      document.getElementById(one.getAttribute("aria-controls")).classList.toggle("open", chosen);
    }
    if (focus) button.focus();
    button.scrollIntoView({ block: "nearest", inline: "nearest" });
    // a section begins at its top, wherever the one before was left
    const main = document.querySelector("main");
    if (main.getBoundingClientRect().top < 0) window.scrollTo(0, main.offsetTop - button.offsetHeight - 4);
  };
  const named = () => buttons.find((one) => "#" + one.getAttribute("aria-controls") === location.hash);
  buttons.forEach((button, at) => {
    button.addEventListener("click", () => {
      open(button, false);
      history.replaceState(null, "", "#" + button.getAttribute("aria-controls"));
    });
    button.addEventListener("keydown", (event) => {
      const last = buttons.length - 1;
      const to = { ArrowRight: at === last ? 0 : at + 1, ArrowLeft: at === 0 ? last : at - 1, Home: 0, End: last }[event.key];
      if (to === undefined) return;
      event.preventDefault();
      buttons[to].click();
      buttons[to].focus();
    });
  });
  window.addEventListener("hashchange", () => { if (named()) open(named(), false); });
  document.documentElement.classList.add("scripted");
  open(named() || buttons[0], false);
}

function views() {
  const data = document.getElementById("data");
  if (!data) return;
  const all = JSON.parse(data.textContent);
  const by = (id) => document.getElementById(id);
  const film = by("film"), frame = by("frame"), slide = by("slide"), toggle = by("difference");
  const shots = [...film.children];
  const radios = [...document.querySelectorAll("input[name=model]")];
  const state = { view: 0, model: radios[0].value, difference: false };
  let order = [];

  // worst first for the model that is shown
  const sort = () => {
    const score = (at) => (all[at].models[state.model] || { psnr: Infinity }).psnr;
    order = all.map((_, at) => at).sort((a, b) => score(a) - score(b) || a - b);
    film.append(...order.map((at) => shots[at]));
  };
  const cut = () => {
    const share = Number(slide.value);
    by("over").style.clipPath = `inset(0 0 0 ${share}%)`;
    by("handle").style.left = share + "%";
  };
  const show = () => {
    const view = all[state.view], model = view.models[state.model];
    frame.style.aspectRatio = `${view.width} / ${view.height}`;
    // as large as the window allows, but not far beyond the pixels that there are
    const width = `min(100%, 72vh * ${view.width} / ${view.height}, max(320px, ${2 * view.width}px))`;
    frame.style.width = slide.style.width = width;
    by("under").src = shots[state.view].querySelector("img").src;
    by("over").src = state.difference ? model.difference : model.render;
    by("over").alt = state.difference ? "Difference of render and truth" : "Render";
    const label = radios.find((one) => one.value === state.model).parentElement.textContent.trim();
    by("side").textContent = `${state.difference ? "difference" : "render"}, ${label}`;
    by("caption").textContent = `${order.indexOf(state.view) + 1} of ${all.length}: ${view.name}, ` +
      `PSNR ${model.psnr.toFixed(2)} dB, SSIM ${model.ssim.toFixed(4)}`;
    toggle.setAttribute("aria-pressed", String(state.difference));
    by("ramp").hidden = !state.difference;
    by("hidden-note").hidden = !view.masked;
    shots.forEach((shot, at) => {
      if (at === state.view) shot.setAttribute("aria-current", "true");
      else shot.removeAttribute("aria-current");
      shot.tabIndex = at === state.view ? 0 : -1;
    });
    cut();
  };
  const turn = (by_how_many, focus) => {
    const at = order.indexOf(state.view) + by_how_many;
    state.view = order[Math.min(Math.max(at, 0), order.length - 1)];
    show();
    if (focus) shots[state.view].focus();
  };
  const choose = (model) => {
    state.model = model;
    radios.forEach((one) => { one.checked = one.value === model; });
    sort();
    show();
  };
  const flip = () => { state.difference = !state.difference; show(); };
  const drag = (event) => {
    const box = frame.getBoundingClientRect();
    slide.value = String(Math.round(100 * (event.clientX - box.left) / box.width));
    cut();
  };

  shots.forEach((shot, at) => {
    shot.addEventListener("click", () => { state.view = at; show(); });
    shot.addEventListener("keydown", (event) => {
      const way = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
      if (!way) return;
      event.preventDefault();
      turn(way, true);
    });
  });
  radios.forEach((one) => one.addEventListener("change", () => choose(one.value)));
  slide.addEventListener("input", cut);
  toggle.addEventListener("click", flip);
  by("previous").addEventListener("click", () => turn(-1, false));
  by("next").addEventListener("click", () => turn(1, false));
  frame.addEventListener("pointerdown", (event) => { frame.setPointerCapture(event.pointerId); drag(event); });
  frame.addEventListener("pointermove", (event) => { if (frame.hasPointerCapture(event.pointerId)) drag(event); });
  document.addEventListener("keydown", (event) => {
    const shown = by("views").classList.contains("open");
    if (!shown || event.ctrlKey || event.metaKey || event.altKey) return;
    const other = radios.find((one) => one.value !== state.model);
    if (event.key === "d") flip();
    else if (event.key === "n") turn(1, false);
    else if (event.key === "p") turn(-1, false);
    else if (event.key === "m" && other) choose(other.value);
  });
  by("viewer").hidden = false;
  sort();
  state.view = order[0];
  show();
}

function sheets() {
  for (const button of document.querySelectorAll("button.sheet")) {
    button.addEventListener("click", () => {
      button.setAttribute("aria-pressed", String(button.getAttribute("aria-pressed") !== "true"));
    });
  }
}

tabs();
views();
sheets();
