// A job as it goes on: its events, and the curve of its error where its stage names one.
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

const curve = [];
function draw(stage) {
  const found = /error ([0-9.eE+-]+)/.exec(stage || '');
  if (!found) return;
  curve.push(Number(found[1]));
  const line = page.querySelector('[data-live="curve"]');
  if (!line || curve.length < 2) return;
  const logs = curve.map(value => Math.log10(Math.max(value, 1e-12)));
  const [low, high] = [Math.min(...logs), Math.max(...logs)];
  const points = logs.map((value, at) => {
    const x = 60 + 620 * at / (logs.length - 1);
    const y = 20 + 140 * (high > low ? (high - value) / (high - low) : 0.5);
    return `${x.toFixed(1)} ${y.toFixed(1)}`;
  });
  line.setAttribute('d', `M${points.join('L')}`);
  set('low', (10 ** low).toPrecision(2));
  set('high', (10 ** high).toPrecision(2));
  page.querySelector('[data-live="figure"]').classList.remove('hidden');
}

function update(job) {
  set('state', job.state);
  set('stage', job.stage || '');
  set('share', `${Math.round(100 * job.progress)} %`);
  set('eta', job.eta_s === null ? 'not known yet' : `about ${duration(job.eta_s)}`);
  const bar = page.querySelector('progress');
  if (bar) bar.value = job.progress;
  draw(job.stage);
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
