#!/usr/bin/env python3
"""Iterates a drive from outside the service, as a laboratory's own tool does. Needs NumPy only.

    python3 examples/iterate.py http://127.0.0.1:8080 bench-1 RUN --model 1 --out drive.npy

RUN is the id of the run whose responses are the target. The tool asks for the regularised inverse of the model's FRF
once, then for one prediction an iteration:

    u <- u + gain * H^+ (target - predicted(u))

It keeps the best drive and writes it as NPY, [samples, drives]. A token is read from the environment (RIGCAST_TOKEN).
"""

import argparse
import io
import json
import os
import urllib.request

import numpy as np

NPY = "application/x-npy"


def call(url, accept, body=None):
    """The body and the headers of an answer; an error of the service ends the program with its problem document."""
    request = urllib.request.Request(url, data=body, headers={"Accept": accept})
    if body is not None:
        request.add_header("Content-Type", NPY)
    if "RIGCAST_TOKEN" in os.environ:
        request.add_header("Authorization", "Bearer " + os.environ["RIGCAST_TOKEN"])
    try:
        with urllib.request.urlopen(request) as answer:
            return answer.read(), answer.headers
    except urllib.error.HTTPError as error:
        raise SystemExit(error.read().decode())


def array(body):
    return np.load(io.BytesIO(body), allow_pickle=False)


def inverse_filter(inverse):
    """A function that applies H^+ [line, drive, response] to a signal [samples, responses]."""
    taps = 2 * (inverse.shape[0] - 1)
    # The impulse response reaches as far before zero as behind it.
    impulse = np.roll(np.fft.irfft(inverse, taps, axis=0), taps // 2, axis=0)

    def apply(signal):
        samples = signal.shape[0]
        # The signal goes on with its first and last values beyond its ends.
        padded = np.pad(signal, ((taps, taps), (0, 0)), mode="edge")
        n = padded.shape[0] + taps
        spectrum = np.fft.rfft(padded, n, axis=0)
        drives = np.einsum("fij,fj->fi", np.fft.rfft(impulse, n, axis=0), spectrum)
        return np.fft.irfft(drives, n, axis=0)[taps + taps // 2 :][:samples]

    return apply


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("service", help="address of the service, http://127.0.0.1:8080")
    parser.add_argument("rig")
    parser.add_argument("run", help="run with the target")
    parser.add_argument("--model", type=int, required=True, help="version; it must have an FRF")
    parser.add_argument("--iterations", type=int, default=10)
    parser.add_argument("--gain", type=float, default=1.0)
    parser.add_argument("--out", default="drive.npy")
    asked = parser.parse_args()
    rig = f"{asked.service}/v1/rigs/{asked.rig}"

    model = json.loads(call(f"{rig}/models/{asked.model}", "application/json")[0])
    inputs, outputs = model["inputs"], model["outputs"]
    channels = "&channels=" + ",".join(outputs)
    body, headers = call(f"{rig}/runs/{asked.run}/data?{channels}", NPY)
    target, rate = array(body), headers["Rigcast-Sample-Rate-Hz"]
    inverse = array(call(f"{rig}/models/{asked.model}/frf?inverse=true", NPY)[0])
    correct = inverse_filter(inverse)

    def predict(drive):
        file = io.BytesIO()
        np.save(file, drive)
        query = f"model={asked.model}&sample_rate_hz={rate}"
        body, headers = call(f"{rig}/predict?{query}", NPY, file.getvalue())
        return array(body).astype(float), headers.get("Rigcast-Trust-Inside", "unknown")

    drive = np.zeros((target.shape[0], len(inputs)))
    best, least, gain = drive, np.inf, asked.gain
    for iteration in range(asked.iterations + 1):
        response, inside = predict(drive)
        error = target - response
        size = np.sqrt((error**2).sum(axis=0) / (target**2).sum(axis=0))
        total = float(np.sqrt((size**2).mean()))
        each = ", ".join(f"{name} {100 * share:.2f} %" for name, share in zip(outputs, size))
        print(f"iteration {iteration}: error {each}; inside the training {inside}", flush=True)
        if total < least:
            best, least, kept = drive, total, error
        else:
            gain /= 2
        drive = best + gain * correct(kept)
    np.save(asked.out, best)
    print(f"best: {100 * least:.3f} %, written to {asked.out}")


if __name__ == "__main__":
    main()
