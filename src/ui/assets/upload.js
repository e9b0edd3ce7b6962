// Uploads: the file goes to the service once without being stored, to show what it is taken for, then for good.
import {call, clear, pageOf, Refusal, secretHeaders, show} from './api.js';

const form = document.querySelector('form[data-upload]');
const drop = form.querySelector('.drop');
const picker = form.querySelector('input[type=file]');
const bar = form.querySelector('progress');
const said = form.querySelector('[data-said]');
const refused = form.querySelector('[data-refused]');
const understood = document.querySelector('[data-understood]');
const accept = document.querySelector('[data-accept]');
let file = null;

const types = {
  csv: 'text/csv', txt: 'text/csv', npy: 'application/x-npy', npz: 'application/x-npz', rsp: 'application/x-rpc3',
  drv: 'application/x-rpc3', tim: 'application/x-rpc3', rpc: 'application/x-rpc3', mat: 'application/x-matlab-data',
  h5: 'application/x-hdf5', hdf5: 'application/x-hdf5', hdf: 'application/x-hdf5', unv: 'application/x-uff58',
  uff: 'application/x-uff58', json: 'application/json',
};

function address(dry) {
  const url = new URL(form.dataset.upload, document.baseURI);
  for (const field of form.querySelectorAll('[name]')) {
    const text = field.type === 'checkbox' ? (field.checked ? 'true' : '') : field.value.trim();
    if (field.name === 'csrf' || text === '') continue;
    const values = field.name === 'tag' ? text.split(',').map(tag => tag.trim()).filter(Boolean) : [text];
    for (const value of values) url.searchParams.append(field.name, value);
  }
  if (dry) url.searchParams.set('dry_run', 'true');
  return url;
}

const megabytes = n => (n / 1e6).toFixed(n < 1e7 ? 2 : 0);

// Fetch does not tell how much of a body has gone out; an XMLHttpRequest does.
function send(dry, key) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open('POST', address(dry));
    const kind = types[file.name.split('.').pop().toLowerCase()] || 'application/octet-stream';
    request.setRequestHeader('Content-Type', kind);
    if (key) request.setRequestHeader('Idempotency-Key', key);
    for (const [name, value] of Object.entries(secretHeaders())) request.setRequestHeader(name, value);
    request.upload.addEventListener('progress', event => {
      bar.value = event.loaded / event.total;
      said.textContent = event.loaded < event.total
        ? `${megabytes(event.loaded)} of ${megabytes(event.total)} MB sent`
        : 'Sent; the service reads the file.';
    });
    request.addEventListener('load', () => {
      let body = {};
      try { body = JSON.parse(request.responseText); } catch { /* the status says enough */ }
      if (request.status < 300) resolve({body, location: request.getResponseHeader('Location')});
      else reject(new Refusal({errors: [], detail: `The service answered with status ${request.status}.`, ...body}));
    });
    request.addEventListener('error', () => reject(new Refusal({
      errors: [],
      detail: 'The connection was lost before the file had gone out whole. Nothing was stored twice: send it again.',
    })));
    request.send(file);
  });
}

async function attempt(dry, key) {
  bar.value = 0;
  bar.classList.remove('hidden');
  clear(refused);
  accept.disabled = true;
  try {
    // A session that began again in another window is taken up before the long way.
    await call('GET', '/session');
    return await send(dry, key);
  } catch (error) {
    said.textContent = '';
    show(refused, error);
    return null;
  } finally {
    bar.classList.add('hidden');
    accept.disabled = false;
  }
}

function row(table, cells) {
  const tr = table.insertRow();
  for (const cell of cells) tr.insertCell().textContent = cell;
}

function tell(body) {
  const facts = understood.querySelector('dl');
  const fact = (name, text) => {
    const [dt, dd] = [document.createElement('dt'), document.createElement('dd')];
    dt.textContent = name;
    dd.textContent = text;
    facts.append(dt, dd);
  };
  facts.replaceChildren();
  fact('File', file.name);
  fact('Format', body.format);
  fact('Sample rate', `${body.sample_rate_hz} Hz`);
  fact('Length', `${body.duration_s} s, ${body.samples} samples`);
  fact('Fits', body.policy);
  if (body.duplicate_of) fact('Same bytes', `run ${body.duplicate_of}`);
  const columns = understood.querySelector('tbody');
  columns.replaceChildren();
  for (const column of body.columns) {
    const unit = column.unit ? ` in ${column.unit}` : '';
    row(columns, [column.name + unit, column.channel ?? 'left out', column.factor === 1 ? 'none' : `times ${column.factor}`]);
  }
  const warnings = understood.querySelector('ul');
  warnings.replaceChildren(...body.quality.warnings.map(text => {
    const li = document.createElement('li');
    li.textContent = text;
    return li;
  }));
  understood.querySelector('[data-clean]').classList.toggle('hidden', body.quality.warnings.length > 0);
  understood.classList.remove('hidden');
}

async function look() {
  if (!file) return;
  understood.classList.add('hidden');
  drop.querySelector('[data-file]').textContent = `${file.name}, ${megabytes(file.size)} MB`;
  const answer = await attempt(true);
  if (!answer) return;
  said.textContent = 'The service has read the file; nothing is stored yet.';
  tell(answer.body);
  accept.focus();
}

// One key for one file and one description: sent again after a lost connection, it is stored once.
let key = null;
accept.addEventListener('click', async () => {
  key ??= crypto.randomUUID ? crypto.randomUUID() : `${Date.now()}-${Math.random()}`;
  const answer = await attempt(false, key);
  if (answer) location.assign(pageOf(answer.location));
});
form.addEventListener('change', event => {
  key = null;
  if (event.target !== picker) { look(); return; }
  file = picker.files[0] || null;
  look();
});
form.addEventListener('submit', event => event.preventDefault());
for (const name of ['dragover', 'dragleave', 'drop']) {
  drop.addEventListener(name, event => {
    event.preventDefault();
    drop.classList.toggle('over-it', name === 'dragover');
    if (name === 'drop' && event.dataTransfer.files.length) {
      key = null;
      file = event.dataTransfer.files[0];
      look();
    }
  });
}
