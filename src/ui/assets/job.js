// A job as it goes on: its events, and the loss curve of its training.
import {load} from './figures.js';

const page = document.querySelector('[data-job]');

function duration(s) {
  if (s < 90) return `${Math.max(1, Math.round(s))} s`;
  if (s < 5400) return `${Math.round(s / 60)} min`;
  return `${(s / 3600).toFixed(1)} h`;
}

function set(name, text) {
  const at = page.querySelector(`[data-live="${name}"]`);
  if (at && at.textContent !== text) at.textContent = text;
}

// The loss curve is drawn by the server. While one is on its way, later news wait for it, and the last one is enough.
const losses = page?.querySelector('[data-live="losses"]');
let busy = false;
let stale = false;
async function draw() {
  if (!losses) return;
  stale = true;
  if (busy) return;
  busy = true;
  while (stale) {
    stale = false;
    const box = losses.querySelector('[data-figure]');
    await load(box);
    losses.classList.toggle('hidden', !box.querySelector('svg'));
  }
  busy = false;
}

function update(job) {
  set('state', job.state);
  set('stage', job.stage || '');
  set('share', `${Math.round(100 * job.progress)} %`);
  set('eta', job.eta_s === null ? 'not known yet' : `about ${duration(job.eta_s)}`);
  const bar = page.querySelector('progress');
  if (bar) bar.value = job.progress;
  draw();
}

if (page && page.dataset.over === undefined) {
  const events = new EventSource(`/v1/jobs/${page.dataset.job}/events`);
  const over = ['succeeded', 'failed', 'cancelled'];
  events.addEventListener('job', event => {
    const job = JSON.parse(event.data);
    set('line', '');
    update(job);
    if (over.includes(job.state)) {
      events.close();
      // The page of the finished job has its result or its problem.
      location.reload();
    }
  });
  events.addEventListener('error', () => {
    const ended = events.readyState === EventSource.CLOSED;
    set('line', ended
      ? 'The service no longer sends news of this job: sign in again, or load the page.'
      : 'The connection is lost; trying again.');
  });
}
