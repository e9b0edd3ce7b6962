#!/usr/bin/env python3
"""Makes the SciPy vectors that the error figures are tested against.

    python3 scripts/scipy_vectors.py            # writes tests/vectors/errors.json

Needs scipy and numpy (made with scipy 1.17.1, numpy 2.4.6). The signals follow from integers alone
(a linear congruential generator) and a handful of sines, so that the test makes the same ones; only
the figures are stored. `psd_rms` is that of `scipy.signal.welch` with a Hann window, half overlap,
4096 samples or the whole signal if that is shorter, and `detrend="constant"`, SciPy's default: the
mean of each segment is removed.
"""

import json
import pathlib

import numpy as np
from scipy.signal import welch

RATE_HZ = 1000.0
OUT = pathlib.Path(__file__).resolve().parent.parent / "tests" / "vectors" / "errors.json"

# Samples, mean of the measured signal, mean of the predicted one. The means are preloads: far above
# what moves, or none at all.
CASES = [(20_000, 40.0, 40.5), (9_001, -3.0, -3.0), (4_096, 0.0, 0.1), (777, 1000.0, 1000.0), (2, 5.0, 4.0)]


def noise(n, seed):
    """Uniform in -1..1, bit for bit the same in any language."""
    state = (seed * 2862933555777941757 + 3037000493) % 2**64
    values = np.empty(n)
    for i in range(n):
        state = (state * 6364136223846793005 + 1442695040888963407) % 2**64
        values[i] = (state >> 11) / 2**52 - 1.0
    return values


def signals(n, measured_mean, predicted_mean):
    """A measured signal and one that is a little too large, a little late and a little noisy."""
    t = np.arange(n) / RATE_HZ
    wave = lambda late: np.sin(2 * np.pi * 7.3 * (t - late)) + 0.4 * np.sin(2 * np.pi * 31.0 * (t - late))
    measured = measured_mean + wave(0.0) + 0.2 * noise(n, 1)
    predicted = predicted_mean + 1.06 * wave(0.002) + 0.2 * noise(n, 2)
    return measured, predicted


def rms(measured, predicted):
    """The source paper's, section 3.2."""
    return float(np.sqrt(np.sum((measured - predicted) ** 2) / np.sum(measured**2)))


def density(samples):
    n = min(len(samples), 4096)
    return welch(samples, RATE_HZ, window="hann", nperseg=n, noverlap=n // 2, detrend="constant")[1]


def figures(n, measured_mean, predicted_mean):
    measured, predicted = signals(n, measured_mean, predicted_mean)
    y, p = measured - np.mean(measured), predicted - np.mean(predicted)
    return {
        "samples": n,
        "measured_mean": measured_mean,
        "predicted_mean": predicted_mean,
        "rms": rms(measured, predicted),
        "rms_ac": float(np.sqrt(np.sum((y - p) ** 2) / np.sum(y**2))),
        "mean": float((np.mean(predicted) - np.mean(measured)) / np.std(measured)),
        "psd_rms": rms(density(measured), density(predicted)),
    }


if __name__ == "__main__":
    OUT.write_text(json.dumps([figures(*case) for case in CASES], indent=2) + "\n")
    print(OUT)
