"use strict";
// Tabs, and the slider of the held-out views. Without this script every section is shown in a row.

function tabs() {
  const buttons = [...document.querySelectorAll("[role=tab]")];
  const open = (button, focus) => {
    for (const tab of buttons) {
      const chosen = tab === button;
      tab.setAttribute("aria-selected", String(chosen));
      tab.tabIndex = chosen ? 0 : -1;
      document.getElementById(tab.getAttribute("aria-controls")).classList.toggle("open", chosen);
    }
    if (focus) button.focus();
    // along the row alone: the page opens at its top
    button.parentElement.scrollLeft = button.offsetLeft + button.offsetWidth - button.parentElement.clientWidth;
    // show a section from its top, however far the last one was scrolled
    const main = document.querySelector("main");
    if (main.getBoundingClientRect().top < 0) window.scrollTo(0, main.offsetTop - button.offsetHeight - 4);
  };
  const named = () => buttons.find((tab) => "#" + tab.getAttribute("aria-controls") === location.hash);
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
  const state = { view: 0, model: (radios.find((radio) => radio.checked) || radios[0]).value, difference: false };
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
    // as large as the window allows, but at most twice the number of pixels
    const width = `min(100%, 72vh * ${view.width} / ${view.height}, max(320px, ${2 * view.width}px))`;
    frame.style.width = slide.style.width = width;
    by("under").src = shots[state.view].querySelector("img").src;
    by("over").src = state.difference ? model.difference : model.render;
    by("over").alt = state.difference ? "Difference of render and truth" : "Render";
    const label = radios.find((radio) => radio.value === state.model).parentElement.textContent.trim();
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
  const turn = (step, focus) => {
    const at = order.indexOf(state.view) + step;
    state.view = order[Math.min(Math.max(at, 0), order.length - 1)];
    show();
    if (focus) shots[state.view].focus();
  };
  const choose = (model) => {
    state.model = model;
    radios.forEach((radio) => { radio.checked = radio.value === model; });
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
      const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
      if (!step) return;
      event.preventDefault();
      turn(step, true);
    });
  });
  radios.forEach((radio) => radio.addEventListener("change", () => choose(radio.value)));
  slide.addEventListener("input", cut);
  toggle.addEventListener("click", flip);
  by("previous").addEventListener("click", () => turn(-1, false));
  by("next").addEventListener("click", () => turn(1, false));
  frame.addEventListener("pointerdown", (event) => { frame.setPointerCapture(event.pointerId); drag(event); });
  frame.addEventListener("pointermove", (event) => { if (frame.hasPointerCapture(event.pointerId)) drag(event); });
  document.addEventListener("keydown", (event) => {
    const open = by("views").classList.contains("open");
    if (!open || event.ctrlKey || event.metaKey || event.altKey) return;
    const other = radios.find((radio) => radio.value !== state.model);
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
