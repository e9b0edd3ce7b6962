// Calls of the service under the session of this page.

const meta = document.querySelector('meta[name="csrf"]');
let csrf = meta ? meta.content : '';

// A refusal as a problem document; a lost connection gets one too.
export class Refusal extends Error {
  constructor(problem) {
    super(problem.detail);
    this.problem = problem;
  }
}

const lost = () => new Refusal({
  title: 'No connection',
  detail: 'The service could not be reached. Nothing that you typed is lost: try again.',
  errors: [],
});

// The CSRF token of the session that this browser has now: it may have signed in again in another window.
async function newToken() {
  const answer = await fetch('/session', {credentials: 'same-origin'});
  if (!answer.ok) return false;
  csrf = (await answer.json()).csrf;
  return true;
}

export function secretHeaders() {
  return csrf ? {'X-CSRF-Token': csrf} : {};
}

async function once(method, path, {body, headers} = {}) {
  try {
    return await fetch(path, {
      method, body, credentials: 'same-origin', headers: {...secretHeaders(), ...headers},
    });
  } catch {
    throw lost();
  }
}

export async function problemOf(answer) {
  try {
    return await answer.json();
  } catch {
    return {title: 'Refused', detail: `The service answered with status ${answer.status}.`, errors: []};
  }
}

// Sends a request; a session that began again meanwhile is taken up.
export async function call(method, path, options) {
  let answer = await once(method, path, options);
  if (answer.status === 403 && (await problemOf(answer.clone())).code === 'csrf.invalid' && await newToken()) {
    answer = await once(method, path, options);
  }
  if (answer.status === 401 && await newToken()) answer = await once(method, path, options);
  if (answer.ok) return answer;
  throw new Refusal(await problemOf(answer));
}

// Address of the page that shows what the API has at this path.
export function pageOf(location) {
  return new URL(location, document.baseURI).pathname.replace(/^\/v1\//, '/');
}

function line(text, kind) {
  const p = document.createElement('p');
  p.textContent = text;
  if (kind) p.className = kind;
  return p;
}

// A box that says what was refused, where, and under which id the log has it.
export function show(box, error) {
  const problem = error instanceof Refusal ? error.problem : {detail: String(error), errors: []};
  box.replaceChildren(line(problem.detail || problem.title));
  for (const at of problem.errors || []) {
    const place = [at.channel && `channel ${at.channel}`, at.pointer, at.row && `row ${at.row}`,
      at.sample !== undefined && `sample ${at.sample}`].filter(Boolean).join(', ');
    if (at.limit && !problem.detail.includes(at.limit)) box.append(line(`${place ? `${place}: ` : ''}${at.limit}`));
  }
  if (problem.code === 'token.missing') {
    const again = line('Your session has ended. ');
    const link = document.createElement('a');
    link.href = '/sign-in?to=/signed-in';
    link.target = '_blank';
    link.rel = 'noopener';
    link.textContent = 'Sign in in another window, then send this again';
    again.append(link);
    box.append(again);
  }
  if (problem.request_id) box.append(line(`Request ${problem.request_id} (${problem.code})`, 'soft'));
  box.classList.add('refused');
  box.setAttribute('role', 'alert');
  box.classList.remove('hidden');
}

export function clear(box) {
  box.replaceChildren();
  box.classList.add('hidden');
}
