#!/usr/bin/env python3
"""Makes the PyTorch vectors that the LSTM kernels are tested against.

    python3 scripts/torch_vectors.py            # writes tests/vectors/lstm_{39,23_23}.safetensors

Needs torch, numpy and safetensors (made with torch 2.8, numpy 2.4, safetensors 0.8). The seed is
fixed, so the same versions write the same bytes.

Each file holds one network with 3 inputs and 3 outputs (one block of 39 cells, or two of 23):

    lstm.weight_ih_l0, ...  PyTorch's parameters, f32, both biases of each gate
    fc.weight, fc.bias
    x        [window, step, input]   standard normal, smoothed
    target   [window, step, output]
    y        [window, step, output]  what PyTorch answers from a zero state
    grad.*   gradient of the mean squared error over all windows and outputs from step
             `burn_in` on, with respect to each parameter
    burn_in  [1]

PyTorch computes in float64 on the float32 weights, so that the vectors are exact to the last digit
that is stored; the test allows 1e-5 of the output's standard deviation for y and 1e-4 of the largest
gradient.
"""

import pathlib

import numpy as np
import torch
from safetensors.numpy import save_file

SEED = 20_240_117
WINDOWS, STEPS, BURN_IN = 20, 64, 16
OUT = pathlib.Path(__file__).resolve().parent.parent / "tests" / "vectors"


class Net(torch.nn.Module):
    """Blocks of memory cells and one fully connected layer without activation."""

    def __init__(self, inputs, cells, blocks, outputs):
        super().__init__()
        self.lstm = torch.nn.LSTM(inputs, cells, num_layers=blocks, batch_first=True)
        self.fc = torch.nn.Linear(cells, outputs)

    def forward(self, x):
        return self.fc(self.lstm(x)[0])


def smooth_noise(rng, *shape):
    """Noise along axis 1 with some memory, about unit variance, rounded to f32."""
    white = rng.standard_normal(shape)
    out = np.zeros(shape)
    for t in range(shape[1]):
        out[:, t] = 0.6 * white[:, t] + (0.8 * out[:, t - 1] if t else 0.0)
    return out.astype(np.float32)


def main():
    OUT.mkdir(parents=True, exist_ok=True)
    for name, cells, blocks in [("lstm_39", 39, 1), ("lstm_23_23", 23, 2)]:
        torch.manual_seed(SEED)
        rng = np.random.default_rng(SEED)
        # Larger than PyTorch's initial weights, so that gates leave their linear range.
        net = Net(3, cells, blocks, 3)
        with torch.no_grad():
            for p in net.parameters():
                p.mul_(2.0)
        weights = {k: p.detach().numpy().copy() for k, p in net.named_parameters()}
        net = net.double()

        x, target = smooth_noise(rng, WINDOWS, STEPS, 3), smooth_noise(rng, WINDOWS, STEPS, 3)
        y = net(torch.from_numpy(x).double())
        error = (y - torch.from_numpy(target).double())[:, BURN_IN:]
        error.square().mean().backward()

        tensors = dict(weights)
        tensors |= {"grad." + k: p.grad.numpy().astype(np.float32) for k, p in net.named_parameters()}
        tensors |= {"x": x, "target": target, "y": y.detach().numpy().astype(np.float32)}
        tensors["burn_in"] = np.array([BURN_IN], dtype=np.float32)
        tensors = {k: np.ascontiguousarray(v) for k, v in tensors.items()}
        save_file(tensors, OUT / f"{name}.safetensors", {"made_by": "scripts/torch_vectors.py"})
        print(name, sum(w.size for w in weights.values()), "weights with both biases")


if __name__ == "__main__":
    main()
