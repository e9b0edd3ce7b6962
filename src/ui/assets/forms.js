// Forms that call the API: data-api="METHOD path"; each field says by data-as how its text is sent.
import {call, clear, pageOf, show} from './api.js';

const kinds = {
  number: Number,
  json: JSON.parse,
  list: text => text.split(',').map(item => item.trim()).filter(Boolean),
  numbers: text => text.split(',').map(item => Number(item.trim())),
  time: text => new Date(text).toISOString(),
};

function put(into, path, value) {
  const last = path[path.length - 1];
  for (const key of path.slice(0, -1)) into = into[key] ??= {};
  into[last] = value;
}

function valueOf(field) {
  const as = field.dataset.as;
  if (as === 'bool') return field.checked || undefined;
  if (field.type === 'checkbox' || field.type === 'radio') {
    if (!field.checked) return undefined;
    return field.dataset.number === undefined ? field.value : Number(field.value);
  }
  const text = field.value.trim();
  if (text === '') return undefined;
  return as && kinds[as] ? kinds[as](text) : text;
}

// The path of a field; `*` stands for a key of its own, which may hold dots.
function pathOf(field) {
  return field.name.split('.').map(part => (part === '*' ? field.dataset.key : part));
}

// The fields inside an element, but for those of rows deeper in it.
function collect(root, own) {
  const found = {};
  for (const field of root.querySelectorAll('input[name], select[name], textarea[name]')) {
    if (field.name === 'csrf' || field.disabled || !own(field)) continue;
    const value = valueOf(field);
    if (value === undefined) continue;
    if (field.dataset.as === 'each') {
      const list = pathOf(field).reduce((at, key) => at?.[key], found) || [];
      put(found, pathOf(field), [...list, value]);
    } else {
      put(found, pathOf(field), value);
    }
  }
  return found;
}

function bodyOf(form) {
  const body = collect(form, field => !field.closest('[data-row]'));
  for (const rows of form.querySelectorAll('[data-rows]')) {
    const items = [...rows.querySelectorAll('[data-row]')].map(row => collect(row, () => true));
    if (items.length) put(body, rows.dataset.rows.split('.'), items);
  }
  return body;
}

// Marks the fields that a refusal points at.
function mark(form, problem) {
  for (const field of form.querySelectorAll('[aria-invalid]')) field.removeAttribute('aria-invalid');
  let first;
  for (const {pointer} of problem?.errors || []) {
    const row = /^\/channels\/(\d+)\/(\w+)$/.exec(pointer);
    const named = field => '/' + pathOf(field).join('/') === pointer;
    const field = row
      ? form.querySelectorAll('[data-row]')[row[1]]?.querySelector(`[name="${row[2]}"]`)
      : [...form.elements].find(field => field.name && named(field));
    field?.setAttribute('aria-invalid', 'true');
    first ??= field;
  }
  first?.focus();
}

async function send(form) {
  const box = form.querySelector('[data-refused]') || form.appendChild(document.createElement('div'));
  box.dataset.refused = '';
  clear(box);
  const [method, path] = form.dataset.api.split(' ');
  const headers = {};
  if (form.dataset.ifMatch) headers['If-Match'] = form.dataset.ifMatch;
  let body;
  if (method !== 'DELETE' && form.dataset.empty === undefined) {
    headers['Content-Type'] = form.dataset.type || 'application/json';
    try {
      body = form.dataset.body || JSON.stringify(bodyOf(form));
    } catch (error) {
      return show(box, error);
    }
  }
  const buttons = form.querySelectorAll('button');
  for (const button of buttons) button.disabled = true;
  try {
    const answer = await call(method, path, {body, headers});
    await done(form, answer);
  } catch (error) {
    mark(form, error.problem);
    show(box, error);
  } finally {
    for (const button of buttons) button.disabled = false;
  }
}

async function done(form, answer) {
  const then = form.dataset.then || 'reload';
  if (then === 'follow') location.assign(pageOf(answer.headers.get('Location')));
  else if (then === 'secret') {
    const {secret} = await answer.json();
    const shown = document.querySelector(form.dataset.shown);
    shown.querySelector('code').textContent = secret;
    shown.classList.remove('hidden');
    shown.focus();
  } else if (then === 'reload') location.reload();
  else location.assign(then);
}

document.addEventListener('submit', event => {
  const form = event.target;
  if (!form.dataset.api) return;
  event.preventDefault();
  if (form.dataset.confirm && !confirm(form.dataset.confirm)) return;
  send(form);
});

// Rows that can be added and taken away.
document.addEventListener('click', event => {
  const button = event.target.closest('[data-add], [data-remove]');
  if (!button) return;
  if (button.dataset.add) {
    const rows = document.querySelector(`[data-rows="${button.dataset.add}"]`);
    const row = document.querySelector(`template[data-of="${button.dataset.add}"]`).content.cloneNode(true);
    rows.append(row);
    rows.lastElementChild.querySelector('input')?.focus();
  } else {
    button.closest('[data-row]').remove();
  }
});

// Parts of a form that belong to some choices only.
function toggle(select) {
  for (const part of select.form.querySelectorAll(`[data-for="${select.name}"]`)) {
    const on = part.dataset.of.split(' ').includes(select.value);
    part.classList.toggle('hidden', !on);
    for (const field of part.querySelectorAll('input, select')) field.disabled = !on;
  }
}
for (const select of document.querySelectorAll('select[data-toggles]')) {
  select.addEventListener('change', () => toggle(select));
  toggle(select);
}

// A field that sends its form when it changes: filters and choices of what a page shows.
document.addEventListener('change', event => {
  if (event.target.dataset.go !== undefined) event.target.form.requestSubmit();
});
