// Figures that come after the page, and figures that zoom: the server draws each view at the resolution of the screen.
import {problemOf, Refusal, show} from './api.js';

function address(box, more) {
  const url = new URL(box.dataset.figure, document.baseURI);
  for (const [name, value] of Object.entries(more)) url.searchParams.set(name, value);
  return url;
}

async function fetchPart(box, view) {
  // A figure that is still hidden has no width of its own.
  const width = Math.max(320, Math.round(box.clientWidth || document.querySelector('main').clientWidth - 48));
  const answer = await fetch(address(box, {...view, as: 'part', width}), {credentials: 'same-origin'});
  if (!answer.ok) throw new Refusal(await problemOf(answer));
  return answer.text();
}

export async function load(box, view = {}) {
  box.setAttribute('aria-busy', 'true');
  try {
    const html = await fetchPart(box, view);
    const parsed = new DOMParser().parseFromString(html, 'text/html');
    box.replaceChildren(...parsed.body.childNodes);
    box.classList.remove('loading');
  } catch (error) {
    const note = document.createElement('div');
    box.replaceChildren(note);
    show(note, error instanceof Refusal ? error : new Refusal({
      detail: 'The figure did not come: the service could not be reached.', errors: [],
    }));
  } finally {
    box.removeAttribute('aria-busy');
  }
}

// A figure that zooms in time: drag, buttons, or keys.
class Zoom {
  constructor(box) {
    this.box = box;
    this.all = [Number(box.dataset.from), Number(box.dataset.to)];
    this.least = Number(box.dataset.least);
    this.view = this.all;
    this.tools = box.parentElement.querySelector('.tools');
    this.tools?.addEventListener('click', event => {
      const button = event.target.closest('[data-zoom]');
      if (button) this.act(button.dataset.zoom);
    });
    box.addEventListener('pointerdown', event => this.begin(event));
    box.addEventListener('keydown', event => {
      const act = {'+': 'in', '=': 'in', '-': 'out', ArrowLeft: 'left', ArrowRight: 'right', 0: 'all'}[event.key];
      if (!act) return;
      event.preventDefault();
      this.act(act);
    });
    box.addEventListener('dblclick', () => this.act('all'));
  }

  act(what) {
    const [from, to] = this.view;
    const span = to - from;
    const moved = {
      in: [from + span / 4, to - span / 4],
      out: [from - span / 2, to + span / 2],
      left: [from - span / 2, to - span / 2],
      right: [from + span / 2, to + span / 2],
      all: this.all,
    }[what];
    this.go(...moved);
  }

  go(from, to) {
    const [first, last] = this.all;
    const span = Math.min(last - first, Math.max(this.least, to - from));
    const start = Math.min(Math.max(first, (from + to - span) / 2), last - span);
    const view = [start, start + span];
    if (view[0] === this.view[0] && view[1] === this.view[1]) return;
    this.view = view;
    this.update();
  }

  update() {
    const view = {from_s: this.view[0], to_s: this.view[1]};
    for (const link of this.box.parentElement.querySelectorAll('[data-save]')) {
      const url = new URL(link.href);
      for (const [name, value] of Object.entries(view)) url.searchParams.set(name, value);
      link.href = url;
    }
    this.box.dispatchEvent(new CustomEvent('zoomed', {detail: view, bubbles: true}));
    return load(this.box, view);
  }

  // Time under a pointer: the axis of the nearest picture.
  timeAt(event) {
    const svg = event.target.closest('svg') || this.box.querySelector('svg');
    const frame = svg.getBoundingClientRect();
    const scale = frame.width / svg.viewBox.baseVal.width;
    const left = frame.left + scale * svg.dataset.left;
    const right = frame.left + scale * svg.dataset.right;
    const share = Math.min(1, Math.max(0, (event.clientX - left) / (right - left)));
    return this.view[0] + share * (this.view[1] - this.view[0]);
  }

  begin(event) {
    if (event.button !== 0 || !this.box.querySelector('svg')) return;
    const start = this.timeAt(event);
    const x = event.clientX - this.box.getBoundingClientRect().left;
    const shade = document.createElement('div');
    shade.className = 'chosen-span';
    this.box.append(shade);
    this.box.setPointerCapture(event.pointerId);
    const move = moved => {
      const here = moved.clientX - this.box.getBoundingClientRect().left;
      shade.style.left = `${Math.min(x, here)}px`;
      shade.style.width = `${Math.abs(here - x)}px`;
    };
    const end = ended => {
      this.box.removeEventListener('pointermove', move);
      shade.remove();
      const stop = this.timeAt(ended);
      const moved = Math.abs(ended.clientX - this.box.getBoundingClientRect().left - x);
      if (ended.type === 'pointerup' && moved > 4) this.go(Math.min(start, stop), Math.max(start, stop));
    };
    this.box.addEventListener('pointermove', move);
    this.box.addEventListener('pointerup', end, {once: true});
    this.box.addEventListener('pointercancel', end, {once: true});
  }
}

const late = [...document.querySelectorAll('[data-figure][data-late]')];
async function work() {
  while (late.length) await load(late.shift());
}
for (const box of document.querySelectorAll('.zoom[data-figure]')) new Zoom(box);
// One after the other, so that a page with many figures does not crowd out other people.
work().then(() => { document.body.dataset.drawn = 'true'; });
