#!/usr/bin/env python3
"""Makes the Keras vectors that the preset of the paper is tested against.

    python3 scripts/keras_vectors.py            # writes tests/vectors/keras_{10,6_5}.safetensors

Needs tensorflow-cpu 2.15 (the last one with the optimisers of the paper's time beside the new ones),
numpy and safetensors. The seed is fixed, so the same versions write the same bytes.

Each file holds one network as Keras makes, starts and trains it (Heindel et al., section 2.2): LSTM
blocks and a dense layer without activation, mean squared error, RMSProp with its defaults at a
constant rate, windows of 64 samples every 32 from the first sample of each run, the last incomplete
one left out, all of them in one mini-batch (so that their order does not matter):

    start.*   weights as Keras draws them, then
    best.*    of the epoch with the lowest loss on the validation run, in PyTorch's layout: lstm.{i}.weight_ih [4 * cells, inputs],
              lstm.{i}.weight_hh [4 * cells, cells], lstm.{i}.bias, fc.weight, fc.bias; gates i, f, g, o
    x.{r}, y.{r}                  training runs, [sample, channel]
    validation.x, validation.y    a validation run whose length is a multiple of the window
    loss      [epoch]             training loss of each epoch, before its step
    validation.loss  [epoch]      loss on the validation run's windows, laid end to end, after it
    rate, best.epoch (from 1)     [1]

RMSProp is that of the paper's time (`tf.keras.optimizers.legacy`, the class that was
`tf.keras.optimizers.RMSprop` until 2.10): epsilon is added to the root.

Keras computes in float64 on a float32 start, so that what is stored is exact to its last digit.
"""

import os
import pathlib

os.environ["TF_CPP_MIN_LOG_LEVEL"] = "2"
os.environ["TF_ENABLE_ONEDNN_OPTS"] = "0"

import numpy as np
import tensorflow as tf
from safetensors.numpy import save_file

SEED = 20_210_708
LENGTH, HOP, EPOCHS, RATE = 64, 32, 12, 2e-2
OUT = pathlib.Path(__file__).resolve().parent.parent / "tests" / "vectors"


def run(rng, samples):
    """Two smooth inputs, and two outputs that lag and bend; standardised well enough, in f32."""
    white = rng.standard_normal((samples, 2))
    x, y = np.zeros_like(white), np.zeros_like(white)
    for t in range(samples):
        x[t] = 0.6 * white[t] + (0.8 * x[t - 1] if t else 0.0)
        push = np.tanh([x[t, 0] + 0.5 * x[t, 1], x[t, 1]])
        y[t] = 0.5 * push + (0.6 * y[t - 1] if t else 0.0)
    return x.astype(np.float32), y.astype(np.float32)


def windows(signal, hop):
    """[window, step, channel] from the first sample on; an incomplete last window is left out."""
    starts = range(0, len(signal) - LENGTH + 1, hop)
    return np.stack([signal[s : s + LENGTH] for s in starts]).astype(np.float64)


def weights(model, blocks):
    tensors = {}
    for i in range(blocks):
        kernel, recurrent, bias = model.layers[i].get_weights()
        tensors |= {f"lstm.{i}.weight_ih": kernel.T, f"lstm.{i}.weight_hh": recurrent.T, f"lstm.{i}.bias": bias}
    kernel, bias = model.layers[blocks].get_weights()
    tensors |= {"fc.weight": kernel.T, "fc.bias": bias}
    return {name: np.ascontiguousarray(w, dtype=np.float32) for name, w in tensors.items()}


def main():
    OUT.mkdir(parents=True, exist_ok=True)
    tf.keras.backend.set_floatx("float64")
    for name, blocks in [("keras_10", [10]), ("keras_6_5", [6, 5])]:
        tf.keras.utils.set_random_seed(SEED)
        rng = np.random.default_rng(SEED)
        runs = [run(rng, 500), run(rng, 333)]
        x, y = (np.concatenate([windows(r[k], HOP) for r in runs]) for k in (0, 1))
        validation = run(rng, 6 * LENGTH)
        layers = [tf.keras.layers.LSTM(cells, return_sequences=True) for cells in blocks]
        model = tf.keras.Sequential([*layers, tf.keras.layers.Dense(2)])
        model.build((None, LENGTH, 2))
        # What is stored is where it starts.
        model.set_weights([w.astype(np.float32).astype(np.float64) for w in model.get_weights()])
        tensors = {"start." + k: w for k, w in weights(model, len(blocks)).items()}
        model.compile(optimizer=tf.keras.optimizers.legacy.RMSprop(learning_rate=RATE), loss="mse")
        epochs = []
        fitted = model.fit(
            x, y, batch_size=len(x), epochs=EPOCHS, verbose=0,
            validation_data=tuple(windows(v, LENGTH) for v in validation), validation_batch_size=6,
            callbacks=[tf.keras.callbacks.LambdaCallback(
                on_epoch_end=lambda *_: epochs.append(weights(model, len(blocks))))],
        )
        best = int(np.argmin(fitted.history["val_loss"]))
        tensors |= {"best." + k: w for k, w in epochs[best].items()}
        tensors |= {"best.epoch": np.array([best + 1], dtype=np.float64)}
        for r, (x, y) in enumerate(runs):
            tensors |= {f"x.{r}": x, f"y.{r}": y}
        tensors |= {"validation.x": validation[0], "validation.y": validation[1]}
        tensors |= {"loss": np.array(fitted.history["loss"], dtype=np.float64)}
        tensors |= {"validation.loss": np.array(fitted.history["val_loss"], dtype=np.float64)}
        tensors |= {"rate": np.array([RATE], dtype=np.float64)}
        save_file(tensors, OUT / f"{name}.safetensors", {"made_by": "scripts/keras_vectors.py"})
        print(name, f"loss {fitted.history['loss'][0]:.4f} to {fitted.history['loss'][-1]:.4f}, best epoch {best + 1}")


if __name__ == "__main__":
    main()
