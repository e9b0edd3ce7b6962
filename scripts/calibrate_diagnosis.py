#!/usr/bin/env python3
"""Fits the probabilities that a diagnosis states to how often its verdicts are right.

    calibrate_diagnosis.py CASES.jsonl...

Each line is one blind case: {"kind": the verdict's kind, "probability": what it stated, "right":
whether the verdict as stated was right}. Prints the constants `STATED` of
src/engine/diagnosis/search/decide.rs, per group of kinds [a, b] of the logistic 1 / (1 + exp(-(a + b
logit(p)))), by Newton's method with a weak prior on no correction; and, before and after, the
expected calibration error over ten bins and the Brier score. Run it on a build whose constants are
[0, 1], on seeds that are used for nothing else.
"""

import json
import math
import sys

GROUPS = {
    "named": ["identified", "partial"],
    "family": ["family_only"],
    "set": ["not_distinguishable"],
    "none": ["none_of_catalogue"],
}
# Weight of the prior [a, b] = [0, 1], in cases.
PRIOR = 2.0


def logit(p):
    p = min(max(p, 1e-3), 1.0 - 1e-3)
    return math.log(p / (1.0 - p))


def logistic(x):
    return 1.0 / (1.0 + math.exp(-min(max(x, -40.0), 40.0)))


def cost(cases, a, b):
    logs = (math.log(logistic((a + b * logit(p)) * (1 if right else -1))) for p, right in cases)
    return 0.5 * PRIOR * (a * a + (b - 1.0) ** 2) - sum(logs)


def fit(cases):
    a, b = 0.0, 1.0
    for _ in range(50):
        ga, gb = PRIOR * a, PRIOR * (b - 1.0)
        haa, hab, hbb = PRIOR, 0.0, PRIOR
        for p, right in cases:
            x = logit(p)
            q = logistic(a + b * x)
            ga += q - right
            gb += (q - right) * x
            w = q * (1.0 - q)
            haa += w
            hab += w * x
            hbb += w * x * x
        det = haa * hbb - hab * hab
        da, db = (hbb * ga - hab * gb) / det, (haa * gb - hab * ga) / det
        # Halved until the loss falls: far from the optimum a whole step may overshoot.
        now = cost(cases, a, b)
        while cost(cases, a - da, b - db) > now and abs(da) + abs(db) > 1e-9:
            da, db = 0.5 * da, 0.5 * db
        a, b = a - da, b - db
    return a, b


def quality(cases):
    bins = [[] for _ in range(10)]
    for p, right in cases:
        bins[min(int(10 * p), 9)].append((p, right))
    error = sum(abs(sum(p for p, _ in b) - sum(r for _, r in b)) for b in bins) / len(cases)
    brier = sum((p - r) ** 2 for p, r in cases) / len(cases)
    share = sum(r for _, r in cases) / len(cases)
    return f"{len(cases)} cases, ECE {error:.3f}, Brier {brier:.3f} (best constant {share * (1 - share):.3f})"


def main():
    rows = [json.loads(line) for path in sys.argv[1:] for line in open(path, encoding="utf-8")]
    before, after = [], []
    for name, kinds in GROUPS.items():
        cases = [(r["probability"], float(r["right"])) for r in rows if r["kind"] in kinds]
        a, b = fit(cases)
        print(f"{name}: [{a:.2f}, {b:.2f}] from {len(cases)} cases")
        before += cases
        after += [(logistic(a + b * logit(p)), right) for p, right in cases]
    print("before:", quality(before))
    print("after: ", quality(after))


if __name__ == "__main__":
    main()
