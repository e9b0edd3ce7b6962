#!/usr/bin/env python3
"""Shows how a PyTorch model becomes a safetensors file that Rigcast imports.

    python3 scripts/export_torch.py        # writes tests/vectors/torch_{lstm,hybrid2}*.safetensors

Needs torch, numpy and safetensors (made with torch 2.8, numpy 2.4, safetensors 0.8). Upload the
result with `POST /v1/rigs/{rig}/models`; the service's predictions then match PyTorch's within
1e-5 of the output's standard deviation. To export a model of your own, keep `export` and hand it your
module, scalers and FRF.

What is in a file (see `export`):

    lstm.weight_ih_l0, lstm.weight_hh_l0, lstm.bias_ih_l0, lstm.bias_hh_l0, and _l1, ... for more blocks
    fc.weight, fc.bias                 torch.nn.LSTM and torch.nn.Linear, as state_dict names them
    x.mean, x.std, y.mean, y.std       scalers, z = (v - mean) / std; for hybrid 2 the x are the
                                       model's inputs, then FRF(x) of each output
    frf.freq_hz                        [line], hybrid 2 only: line * sample_rate / segment_len
    frf.re, frf.im                     [line, output, input], response per input with exp(+j w t)
    metadata key "rigcast"             JSON: schema, kind, inputs, outputs, sample_rate_hz, window_len,
                                       hop, recombine

Beside each model the script writes `*_io.safetensors` with a drive `x` [sample, input], what the
model answers, `y.welch` and `y.stream` [sample, output], and for hybrid 2 `frf_x` [sample, output].

The models here have seeded random weights: they show the format, and they are what the service's import
is tested with. The reference prediction below is written for clarity:

- welch: windows of L samples start at -L/2, 0, hop, 2 hop, ...; before the start and after the end
  the input is held; window predictions are averaged with weights (1 - ((2t - L) / L)^2)^10.
- stream: the state is carried through the signal, after 2 L samples of the first value held.
- FRF(x): the impulse response is the inverse transform of H, segment_len taps centred on zero; the
  drive is held at its first and last value outside; means are zero (there is no working point here).
"""

import json
import pathlib

import numpy as np
import torch
from safetensors.numpy import save_file

SEED = 7
SAMPLE_RATE_HZ, SAMPLES, L, HOP, SEGMENT_LEN = 1000.0, 500, 64, 32, 64
INPUTS, OUTPUTS, CELLS = ["drive_x", "drive_y", "drive_z"], ["force_x", "force_y"], 12
OUT = pathlib.Path(__file__).resolve().parent.parent / "tests" / "vectors"


class Net(torch.nn.Module):
    """What Rigcast calls an LSTM: one or more blocks and a fully connected layer."""

    def __init__(self, inputs, cells, outputs):
        super().__init__()
        self.lstm = torch.nn.LSTM(inputs, cells, batch_first=True)
        self.fc = torch.nn.Linear(cells, outputs)

    def forward(self, x):
        return self.fc(self.lstm(x)[0])


def export(path, net, kind, x_scaler, y_scaler, frf=None):
    """Writes a model as Rigcast reads it. `frf`: frequencies and complex H[line, output, input]."""
    tensors = {k: v.detach().cpu().float().numpy() for k, v in net.state_dict().items()}
    tensors |= {"x.mean": x_scaler[0], "x.std": x_scaler[1], "y.mean": y_scaler[0], "y.std": y_scaler[1]}
    if frf is not None:
        tensors |= {"frf.freq_hz": frf[0], "frf.re": frf[1].real, "frf.im": frf[1].imag}
    rigcast = {
        "schema": 1,
        "kind": kind,
        "inputs": INPUTS,
        "outputs": OUTPUTS,
        "sample_rate_hz": SAMPLE_RATE_HZ,
        "window_len": L,
        "hop": HOP,
        "recombine": "welch",
    }
    tensors = {k: np.ascontiguousarray(v) for k, v in tensors.items()}
    save_file(tensors, path, {"rigcast": json.dumps(rigcast)})


def held(x, start, stop):
    """Samples start..stop of x [sample, channel], held at its first and last value outside."""
    return x[np.clip(np.arange(start, stop), 0, len(x) - 1)]


def run(net, x):
    """One window from a zero state, in float64: [sample, input] to [sample, output]."""
    with torch.no_grad():
        return net.double()(torch.from_numpy(x[None]).double())[0].numpy()


def welch(net, x):
    """Windows recombined as a weighted mean."""
    t = np.arange(L)
    weight = (1.0 - ((2.0 * t - L) / L) ** 2) ** 10
    total, y = np.zeros((len(x), 1)), np.zeros((len(x), len(OUTPUTS)))
    for start in [-(L // 2), *range(0, len(x), HOP)]:
        out = run(net, held(x, start, start + L))
        inside = (start + t >= 0) & (start + t < len(x))
        y[start + t[inside]] += weight[inside, None] * out[inside]
        total[start + t[inside]] += weight[inside, None]
    return y / total


def stream(net, x):
    """The state carried through."""
    return run(net, held(x, -2 * L, len(x)))[2 * L :]


def apply_frf(h, x):
    """y = H * x on the whole signal, [sample, input] to [sample, output]."""
    taps = np.roll(np.fft.irfft(h, SEGMENT_LEN, axis=0), SEGMENT_LEN // 2, axis=0)
    # taps[k] belongs to a delay of k - SEGMENT_LEN / 2 samples.
    wide = held(x, -(SEGMENT_LEN // 2 - 1), len(x) + SEGMENT_LEN // 2)
    y = np.zeros((len(x), h.shape[1]))
    for o in range(h.shape[1]):
        for i in range(h.shape[2]):
            y[:, o] += np.convolve(wide[:, i], taps[:, o, i], mode="valid")
    return y


def example_frf():
    """A damped resonance per output at 60 and 90 Hz that each input excites a little differently."""
    freq = np.arange(SEGMENT_LEN // 2 + 1) * SAMPLE_RATE_HZ / SEGMENT_LEN
    gain = np.array([[1.0, 0.2, -0.1], [-0.3, 0.8, 0.25]])
    natural, damping = np.array([60.0, 90.0]), 0.3
    ratio = freq[:, None] / natural
    resonance = 1.0 / (1.0 - ratio**2 + 2j * damping * ratio)
    h = resonance[:, :, None] * gain
    # The mean and the highest line of a real signal have no phase.
    h[[0, -1]] = h[[0, -1]].real
    return freq, h


def drive(rng):
    """Noise below about 100 Hz with an offset, kN."""
    white = rng.standard_normal((SAMPLES, len(INPUTS)))
    x = np.zeros_like(white)
    for t in range(SAMPLES):
        x[t] = 0.4 * white[t] + (0.8 * x[t - 1] if t else 0.0)
    return (x + np.array([0.5, -1.0, 0.0])).astype(np.float32)


def seeded(inputs):
    """A network with weights that let the gates work."""
    net = Net(inputs, CELLS, len(OUTPUTS))
    with torch.no_grad():
        for p in net.parameters():
            p.mul_(2.0)
    return net


def write(name, kind, net, x, features, x_scaler, y_scaler, frf=None, extra=None):
    """The model and what it answers."""
    export(OUT / f"{name}.safetensors", net, kind, x_scaler, y_scaler, frf)
    z = (features - x_scaler[0]) / x_scaler[1]
    io = {"x": x, **(extra or {})}
    for way, predict in [("welch", welch), ("stream", stream)]:
        io[f"y.{way}"] = predict(net, z) * y_scaler[1] + y_scaler[0]
    io = {k: np.ascontiguousarray(v) for k, v in io.items()}
    save_file(io, OUT / f"{name}_io.safetensors", {"made_by": "scripts/export_torch.py"})
    print(name, {k: v.shape for k, v in io.items()})


def main():
    OUT.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(SEED)
    rng = np.random.default_rng(SEED)
    x = drive(rng)
    y_scaler = (np.array([0.3, -2.0]), np.array([1.7, 0.6]))

    x_scaler = (x.mean(0).astype(np.float64), x.std(0).astype(np.float64))
    write("torch_lstm", "lstm", seeded(len(INPUTS)), x, x.astype(np.float64), x_scaler, y_scaler)

    freq, h = example_frf()
    frf_x = apply_frf(h, x.astype(np.float64))
    features = np.concatenate([x, frf_x], axis=1)
    x_scaler = (features.mean(0), features.std(0))
    net = seeded(len(INPUTS) + len(OUTPUTS))
    write("torch_hybrid2", "hybrid2", net, x, features, x_scaler, y_scaler, (freq, h), {"frf_x": frf_x})


if __name__ == "__main__":
    main()
