#!/usr/bin/env python3
"""Measures what others need for the works of `examples/speed`, one JSON line a row.

    cargo run --release --example speed && python3 scripts/peers.py [--works infer,train,frf]
    python3 scripts/peers.py --works lab --kept FOLDER      # the hybrid 2 of a lab's noise: peers_lab.py

Run both in turn on the same machine: only the ratios hold elsewhere. Needs numpy and scipy; the
rows of `infer` and `train` also need torch and are left out without it. Sizes are those of
`examples/speed/works.rs`: at 1 kHz, three drives and six responses, segments of 4096 samples that
half overlap; 9 inputs, 39 cells, 6 outputs, windows of 256 samples that half overlap.
"""

import argparse
import json
import statistics
import time

import numpy as np
import scipy.fft
import scipy.signal

import peers_lab

FS, SEGMENT, WINDOW = 1000, 4096, 256
CORES = 2


def noise(channels, seconds, seed):
    """Noise below about 80 Hz, standard deviation near one, [channel, sample]."""
    white = np.random.default_rng(seed).standard_normal((channels, seconds * FS))
    for _ in range(4):
        white = scipy.signal.lfilter([0.5], [1, -0.5], white)
    return 2.2 * white


def seconds(reps, call):
    """Seconds of each call, after one that is not counted."""
    call()
    took = []
    for _ in range(reps):
        begin = time.perf_counter()
        call()
        took.append(time.perf_counter() - begin)
    return took


def row(work, unit, values):
    values = sorted(values)
    print(json.dumps({"work": work, "unit": unit, "median": statistics.median(values), "min": values[0],
                      "max": values[-1], "reps": len(values)}), flush=True)


def h1(sxx, syx):
    """H = S_yx S_xx^-1 of each line, from [i, j, line] and [o, i, line]."""
    return np.linalg.solve(sxx.transpose(2, 1, 0), syx.transpose(2, 1, 0)).transpose(2, 1, 0)


def frf():
    x, y = noise(3, 1800, 1), noise(6, 1800, 2)

    def scipy_csd():
        welch = {"fs": FS, "nperseg": SEGMENT, "noverlap": SEGMENT // 2, "detrend": False}
        csd = lambda a, b: scipy.signal.csd(b, a, **welch)[1]
        sxx = np.array([[csd(a, b) for b in x] for a in x])
        syx = np.array([[csd(a, b) for b in x] for a in y])
        return h1(sxx, syx)

    row("frf_h1_30min scipy csd", "s", seconds(3, scipy_csd))

    x32, y32 = x.astype(np.float32), y.astype(np.float32)
    window = scipy.signal.get_window("hann", SEGMENT).astype(np.float32)

    def batched():
        """Every channel transformed once a segment, in single precision on all cores."""
        def spectra(signal):
            cut = np.lib.stride_tricks.sliding_window_view(signal, SEGMENT, axis=1)[:, :: SEGMENT // 2]
            lines = scipy.fft.rfft(cut * window, axis=2, workers=CORES)
            return lines.transpose(2, 0, 1)

        a, b = spectra(x32), spectra(y32)
        conj = a.conj().transpose(0, 2, 1)
        return np.linalg.solve((a @ conj).transpose(0, 2, 1), (b @ conj).transpose(0, 2, 1))

    row("frf_h1_30min numpy, batched f32", "s", seconds(5, batched))

    drive = x32[:, : 600 * FS]
    response = np.random.default_rng(3).standard_normal((6, 3, SEGMENT)).astype(np.float32)

    def oaconvolve():
        return sum(scipy.signal.oaconvolve(drive[None, i], response[:, i], axes=1) for i in range(3))

    row("frf_apply_10min scipy oaconvolve", "s", seconds(9, oaconvolve))

    block = 4 * SEGMENT
    step = block - SEGMENT + 1
    lines = scipy.fft.rfft(response, block, axis=2)
    blocks = -(-drive.shape[1] // step)
    padded = np.zeros((3, SEGMENT - 1 + blocks * step), np.float32)
    padded[:, SEGMENT - 1 : SEGMENT - 1 + drive.shape[1]] = drive

    def overlap_save():
        cut = np.lib.stride_tricks.sliding_window_view(padded, block, axis=1)[:, ::step]
        spectra = scipy.fft.rfft(cut, axis=2, workers=CORES)
        product = (lines.transpose(2, 0, 1) @ spectra.transpose(2, 0, 1)).transpose(1, 2, 0)
        return scipy.fft.irfft(product, block, axis=2, workers=CORES)[:, :, SEGMENT - 1 :]

    row("frf_apply_10min numpy, batched overlap-save f32", "s", seconds(9, overlap_save))


def networks(torch):
    class Net(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.lstm = torch.nn.LSTM(9, 39, batch_first=True)
            self.fc = torch.nn.Linear(39, 6)

        def forward(self, x):
            return self.fc(self.lstm(x)[0])

    torch.manual_seed(1)
    torch.set_num_threads(CORES)
    return Net()


def infer(torch):
    net = networks(torch)
    weights = torch.from_numpy(((1 - ((2 * np.arange(WINDOW) - WINDOW) / WINDOW) ** 2) ** 10).astype(np.float32))
    for length in (60, 600):
        x = torch.from_numpy(noise(9, length, 1).astype(np.float32).T.copy())

        @torch.inference_mode()
        def predict():
            windows = x.unfold(0, WINDOW, WINDOW // 2).transpose(1, 2)
            y = torch.cat([net(part) for part in windows.split(512)]) * weights[:, None]
            out = torch.zeros(x.shape[0], 6)
            half = WINDOW // 2
            for first in (0, half):
                flat = y[:, first : first + half].reshape(-1, 6)
                out[first : first + flat.shape[0]] += flat
            return out

        row(f"infer_{length}s torch", "signal_s_per_s", [length / s for s in seconds(5, predict)])


def train(torch):
    x = torch.from_numpy(noise(9, 600, 1).astype(np.float32).T.copy()).unfold(0, WINDOW, WINDOW // 2)
    y = torch.from_numpy(noise(6, 600, 2).astype(np.float32).T.copy()).unfold(0, WINDOW, WINDOW // 2)
    x, y = x.transpose(1, 2).contiguous(), y.transpose(1, 2).contiguous()
    for batch in (32, 128, 512):
        net = networks(torch)
        optimizer = torch.optim.Adam(net.parameters(), 5e-3)
        burn_in = WINDOW // 4

        def epoch():
            for first in range(0, 2048, batch):
                optimizer.zero_grad()
                error = net(x[first : first + batch])[:, burn_in:] - y[first : first + batch, burn_in:]
                (error**2).mean().backward()
                torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
                optimizer.step()

        row(f"train_b{batch} torch", "windows_per_s", [2048 / s for s in seconds(5, epoch)])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--works", default="infer,train,frf")
    parser.add_argument("--kept", help="folder of `whole_work --kept`, for the work `lab`")
    args = parser.parse_args()
    works = args.works.split(",")
    try:
        import torch
    except ImportError:
        torch = None
    if torch and "infer" in works:
        infer(torch)
    if torch and "train" in works:
        train(torch)
    if "frf" in works:
        frf()
    if "lab" in works:
        if not (torch and args.kept):
            parser.error("the work `lab` needs torch, and the folder of `whole_work --kept`")
        peers_lab.run(torch, args.kept)


if __name__ == "__main__":
    main()
