"""The hybrid 2 of a lab's noise as numpy and PyTorch make it: called by `peers.py --works lab --kept FOLDER`.

    cargo run --release --example whole_work -- --rig demo --stages hybrid2,predict,evaluate --kept FOLDER
    python3 scripts/peers.py --works lab --kept FOLDER

The first command leaves the runs and the version that was fitted in FOLDER. This does the same again: the FRF of the same
runs with the same segments and ridge; networks from the same kind of start (a copy of the FRF), for the same seeds, on the
same spans by the same schedule, each kept at its best epoch on the same spans that stop the training; the best of them
once more on all runs; and a prediction of the load. Seeds are trained side by side, a thread each, which is the fastest
way here. Random numbers are torch's own, so networks differ as those of other seeds do.
"""

import json
import math
import multiprocessing
import pathlib
import time

import numpy as np
import scipy.fft
import scipy.signal

CORES = 2


def spectra(signal, segment):
    """Windowed spectra of half overlapping segments, [line, segment, channel]."""
    window = scipy.signal.get_window("hann", segment).astype(np.float32)
    cut = np.lib.stride_tricks.sliding_window_view(signal, segment, axis=1)[:, :: segment // 2]
    return scipy.fft.rfft(cut * window, axis=2, workers=CORES).transpose(2, 1, 0)


def h1(x, y, segment, ridge):
    """H = S_yx (S_xx + ridge diag(level))^-1, [line, output, input], in single precision."""
    a, b = spectra(x, segment), spectra(y, segment)
    sxx = a.transpose(0, 2, 1) @ a.conj()
    syx = b.transpose(0, 2, 1) @ a.conj()
    level = np.einsum("lii->i", sxx).real / sxx.shape[0]
    sxx = sxx + ridge * np.diag(level)[None]
    return np.linalg.solve(sxx.transpose(0, 2, 1), syx.transpose(0, 2, 1)).transpose(0, 2, 1)


def applied(h, x):
    """The response of an FRF by blocks (overlap-save), [output, sample]."""
    segment = 2 * (h.shape[0] - 1)
    response = np.fft.fftshift(scipy.fft.irfft(h, segment, axis=0), axes=0)
    block = 4 * segment
    step = block - segment + 1
    lines = scipy.fft.rfft(response, block, axis=0).astype(np.complex64)
    blocks = -(-x.shape[1] // step)
    padded = np.zeros((x.shape[0], segment - 1 + blocks * step + segment), np.float32)
    # The response begins half a segment before its impulse.
    half = segment // 2
    padded[:, segment - 1 - half : segment - 1 - half + x.shape[1]] = x
    cut = np.lib.stride_tricks.sliding_window_view(padded, block, axis=1)[:, ::step][:, :blocks]
    of_blocks = scipy.fft.rfft(cut, axis=2, workers=CORES).transpose(2, 1, 0)
    product = (of_blocks @ lines.transpose(0, 2, 1)).transpose(2, 1, 0)
    out = scipy.fft.irfft(product, block, axis=2, workers=CORES)[:, :, segment - 1 :]
    return out.reshape(out.shape[0], -1)[:, : x.shape[1]].astype(np.float32)


class Lab:
    """What was kept, and the signals that a network sees."""

    def __init__(self, folder):
        folder = pathlib.Path(folder)
        self.kept = json.loads((folder / "hybrid2.json").read_text())
        self.model = self.kept["model"]
        self.lstm = self.model["report"]["lstm"]
        self.inputs = len(self.model["inputs"])
        load = lambda name: np.ascontiguousarray(np.load(folder / f"{name}.npy").T)
        self.noise = [load(f"noise-{run}") for run in range(len(self.kept["runs"]))]
        parts = sorted(path.stem for path in folder.glob("load-*.npy"))
        self.load = np.concatenate([load(part) for part in parts], axis=1)

    def spans(self, use):
        """(run, from, to) of each span of the lineage."""
        runs = self.kept["runs"]
        return [(runs.index(s["run"]), s["from_sample"], s["to_sample"]) for s in self.model["lineage"][use]]

    def choice(self):
        """Spans that train and that stop while the network is chosen: of runs that do not compare, the last one stops."""
        compared = {run for run, *_ in self.spans("validation")}
        *training, stopping = [span for span in self.spans("training") if span[0] not in compared]
        return training, [stopping]

    def fit_frf(self):
        frf = self.model["report"]["frf"]
        (run, first, last), = self.spans("frf")
        signals = self.noise[run][:, first:last]
        return h1(signals[: self.inputs], signals[self.inputs :], frf["segment_len"], frf["ridge"])

    def scaled(self, linear, training):
        """Standardised inputs and outputs of all runs, [sample, channel], and the scalers."""
        x = [np.concatenate([run[: self.inputs], response]) for run, response in zip(self.noise, linear)]
        y = [run[self.inputs :] for run in self.noise]

        def scaler(of):
            seen = np.concatenate([of[run][:, first:last] for run, first, last in training], axis=1)
            return seen.mean(1, dtype=np.float64), seen.std(1, dtype=np.float64)

        def scale(of, mean, std):
            return [((run - mean[:, None]) / std[:, None]).astype(np.float32).T.copy() for run in of]

        of_x, of_y = scaler(x), scaler(y)
        return scale(x, *of_x), scale(y, *of_y), of_x, of_y


def start(torch, lab, of_x, of_y, seed):
    """A network whose first cells pass the FRF's prediction through."""
    torch.manual_seed(seed)
    (cells,) = lab.lstm["blocks"]
    (mx, sx), (my, sy) = of_x, of_y
    outputs = len(my)
    lstm, fc = torch.nn.LSTM(len(mx), cells, batch_first=True), torch.nn.Linear(cells, outputs)
    with torch.no_grad():
        lstm.bias_hh_l0.zero_()
        lstm.bias_ih_l0[cells : 2 * cells] = lab.lstm["forget_bias"]
        fc.weight.zero_()
        for cell in range(outputs):
            for gate, bias in ((0, 4.0), (1, -6.0), (2, 0.0), (3, 4.0)):
                row = gate * cells + cell
                lstm.weight_ih_l0[row].zero_()
                lstm.weight_hh_l0[row].zero_()
                lstm.bias_ih_l0[row] = bias
            lstm.weight_ih_l0[2 * cells + cell, lab.inputs + cell] = 0.05
            linear = lab.inputs + cell
            fc.weight[cell, cell] = float(sx[linear] / sy[cell]) / (0.05 / (1 + math.exp(-4.0)) ** 2)
            fc.bias[cell] = float((mx[linear] - my[cell]) / sy[cell])
    return torch.nn.Sequential(lstm, fc)


def forward(net, x):
    return net[1](net[0](x)[0])


def windows(spans, lab, offsets):
    """(run, first sample) of all windows of the spans, each span's from its offset on."""
    window, hop = lab.lstm["window_len"], lab.lstm["hop"]
    return [(run, first) for (run, a, b), offset in zip(spans, offsets)
            for first in range(a + offset, b - window + 1, hop)]


def train(torch, lab, signals, spans, stopping, seed, until):
    """The best state and its epoch by the error on `stopping`, or the state after the epoch `until`."""
    x, y, of_x, of_y = signals
    s = lab.lstm
    window, batch, epochs = s["window_len"], s["batch_size"], s["epochs"]
    burn_in = int(s["burn_in"] * window)
    x, y = [torch.from_numpy(v) for v in x], [torch.from_numpy(v) for v in y]
    net = start(torch, lab, of_x, of_y, seed)
    optimizer = torch.optim.Adam(net.parameters(), s["learning_rate"])
    every = s.get("validate_every") or max(epochs // 100, 1)

    def cut(of, part):
        return torch.stack([of[run][first : first + window] for run, first in part])

    stops = windows(stopping, lab, [0] * len(stopping))

    @torch.inference_mode()
    def error():
        sums = [((forward(net, cut(x, part))[:, burn_in:] - cut(y, part)[:, burn_in:]) ** 2).mean().item() * len(part)
                for part in (stops[k : k + 512] for k in range(0, len(stops), 512))]
        return sum(sums) / len(stops)

    generator = np.random.default_rng(seed)
    # The start is left only for an epoch that is clearly better.
    best = (0.9 * error() if stops else math.inf, 0, {k: v.clone() for k, v in net.state_dict().items()})
    step = 0
    for epoch in range(1, (until or epochs) + 1):
        drawn = windows(spans, lab, generator.integers(0, s["hop"], len(spans)))
        generator.shuffle(drawn)
        for first in range(0, len(drawn), batch):
            done = (epoch - 1 + first / len(drawn)) / epochs
            rate = s["learning_rate"] * min((step + 1) / s["warmup_steps"], 1) * 0.5 * (1 + math.cos(math.pi * done))
            for group in optimizer.param_groups:
                group["lr"] = rate
            part = drawn[first : first + batch]
            optimizer.zero_grad()
            loss = ((forward(net, cut(x, part))[:, burn_in:] - cut(y, part)[:, burn_in:]) ** 2).mean()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), s["clip_norm"])
            optimizer.step()
            step += 1
        if stops and (epoch % every == 0 or epoch == epochs):
            now = error()
            if now < best[0]:
                best = (now, epoch, {k: v.clone() for k, v in net.state_dict().items()})
    if until:
        best = (math.nan, until, net.state_dict())
    return best


def predicted(torch, lab, net, signals, h, drive):
    """Windows recombined by the tenth power of Welch's window, [output, sample]."""
    _, _, (mx, sx), (my, sy) = signals
    window, hop = lab.lstm["window_len"], lab.lstm["hop"]
    x = np.concatenate([drive, applied(h, drive)])
    x = ((x - mx[:, None]) / sx[:, None]).astype(np.float32).T
    pad = -(-x.shape[0] // hop) * hop + hop - x.shape[0]
    x = torch.from_numpy(np.concatenate([np.repeat(x[:1], hop, 0), x, np.repeat(x[-1:], pad, 0)]))
    k = np.arange(window)
    weights = torch.from_numpy(((1 - ((2 * k - window) / window) ** 2) ** 10).astype(np.float32))
    with torch.inference_mode():
        cut = x.unfold(0, window, hop).transpose(1, 2)
        y = torch.cat([forward(net, part) for part in cut.split(512)]) * weights[:, None]
        out, total = torch.zeros(x.shape[0], y.shape[2]), torch.zeros(x.shape[0])
        for first in range(0, window, hop):
            flat = y[:, first : first + hop].reshape(-1, y.shape[2])
            out[first : first + flat.shape[0]] += flat
            total[first : first + flat.shape[0]] += weights[first : first + hop].repeat(y.shape[0])
        out = out / total.clamp(min=1e-12)[:, None]
    out = out.numpy()[hop : hop + drive.shape[1]].T
    return out * sy[:, None] + my[:, None]


def error(measured, found):
    """Mean over the outputs of the RMS error as a share of the RMS."""
    return float(np.mean(np.sqrt(((measured - found) ** 2).mean(1) / (measured**2).mean(1))))


shared = {}


def train_apart(seed):
    torch, lab = shared["torch"], shared["lab"]
    torch.set_num_threads(1)
    return train(torch, lab, shared["signals"], *lab.choice(), seed, None)


def run(torch, folder):
    lab = Lab(folder)
    # The way of a fit of four runs and more, whose winner is fitted once more.
    assert lab.model["report"]["comparison"]["refitted"], "fit an hour in six runs, as whole_work does"
    rows, begin = {}, time.perf_counter()

    def lap(name):
        nonlocal begin
        rows[name] = time.perf_counter() - begin
        begin = time.perf_counter()

    h = lab.fit_frf()
    lap("frf")
    linear = [applied(h, run[: lab.inputs]) for run in lab.noise]
    signals = lab.scaled(linear, lab.choice()[0])
    lap("frf applied, standardised")
    seeds = lab.lstm["seeds"]
    shared.update(torch=torch, lab=lab, signals=signals)
    with multiprocessing.get_context("fork").Pool(CORES) as pool:
        trained = pool.map(train_apart, seeds, 1)
    lap("seeds trained")
    k = min(range(len(seeds)), key=lambda k: trained[k][0])
    net = start(torch, lab, *signals[2:], seeds[k])
    net.load_state_dict(trained[k][2])
    compared = []
    for number, first, last in lab.spans("validation"):
        signal = lab.noise[number][:, first:last]
        found = predicted(torch, lab, net, signals, h, signal[: lab.inputs])
        compared.append(error(signal[lab.inputs :], found))
    lap("compared")
    torch.set_num_threads(CORES)
    spans = lab.spans("training")
    signals = lab.scaled(linear, spans)
    if trained[k][1]:
        net.load_state_dict(train(torch, lab, signals, spans, [], seeds[k], trained[k][1])[2])
    lap("once more on all runs")
    fitted = sum(rows.values())
    found = predicted(torch, lab, net, signals, h, lab.load[: lab.inputs])
    lap("load predicted")
    print(json.dumps({
        "work": "lab hybrid2 torch", "fit_s": round(fitted, 1), "parts_s": {k: round(v, 1) for k, v in rows.items()},
        "epochs": [t[1] for t in trained], "error_compared": compared,
        "error_load": error(lab.load[lab.inputs :], found),
        "here": {"error_compared": lab.model["report"]["validation_rms"], "fit_s": lab.kept["seconds"]},
    }), flush=True)
