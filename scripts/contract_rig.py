"""A rig with a run, a model and an ended job for scripts/contract.sh; writes where they are, as settings of schemathesis.

contract_rig.py BASE ALWAYS THERE: what holds always, and what sends requests to the things that are there.
"""

import json
import os
import random
import struct
import sys
import time
import urllib.request

BASE = sys.argv[1]


def send(method, path, body=None, media_type="application/json", **headers):
    data = body if isinstance(body, (bytes, type(None))) else json.dumps(body).encode()
    request = urllib.request.Request(BASE + path, data, method=method)
    request.add_header("Authorization", "Bearer " + os.environ["RIGCAST_TOKEN"])
    request.add_header("Content-Type", media_type)
    for name, value in headers.items():
        request.add_header(name.replace("_", "-"), value)
    with urllib.request.urlopen(request) as answer:
        return json.load(answer)


def weights():
    """y = 2 u, as an FRF without frequency dependence."""
    freq, re, im = [0.0, 25.0, 50.0], [2.0] * 3, [0.0] * 3
    meta = {"schema": 1, "kind": "frf", "inputs": ["u"], "outputs": ["y"], "sample_rate_hz": 100.0}
    tensor = lambda shape, at: {"dtype": "F64", "shape": shape, "data_offsets": [24 * at, 24 * at + 24]}
    header = {"__metadata__": {"rigcast": json.dumps(meta)}, "frf.freq_hz": tensor([3], 0),
              "frf.re": tensor([3, 1, 1], 1), "frf.im": tensor([3, 1, 1], 2)}
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + struct.pack("<9d", *freq, *re, *im)


def rig(rig_id):
    channels = [{"name": "u", "unit": "kN", "role": "drive"}, {"name": "y", "unit": "mm", "role": "response"}]
    return send("POST", "/v1/rigs", {"id": rig_id, "sample_rate_hz": 100.0, "channels": channels})


def run(rig_id, seed):
    noise = random.Random(seed)
    rows = "".join(f"{u:.5f},{2 * u + 0.01 * noise.gauss(0, 1):.5f}\n" for u in (noise.gauss(0, 1) for _ in range(3000)))
    return send("POST", f"/v1/rigs/{rig_id}/runs?kind=noise", ("u,y\n" + rows).encode(), "text/csv")["id"]


rig("bench"), rig("away")
bench_run, other_run = run("bench", 1), run("bench", 2)
send("POST", "/v1/rigs/bench/models", weights(), "application/x-safetensors")
send("PUT", "/v1/rigs/bench/active-model", {"version": 1}, If_Match="*")
job = send("POST", "/v1/rigs/bench/fits", {"kind": "frf"})["id"]
while send("GET", f"/v1/jobs/{job}")["state"] not in ("succeeded", "failed"):
    time.sleep(0.1)

# The token that all requests send must not be the one that is revoked.
other = send("POST", "/v1/tokens", {"role": "reader"})["id"]
with open(sys.argv[2], "w") as always:
    always.write(f"""
[[operations]]
include-operation-id = "revokeToken"
parameters = {{ "path.token" = "{other}" }}
""")
with open(sys.argv[3], "w") as there:
    there.write(f"""
[parameters]
"path.rig" = "bench"
"path.run" = "{bench_run}"
"path.version" = 1
"path.job" = "{job}"

[[operations]]
include-operation-id = "deleteRig"
parameters = {{ "path.rig" = "away" }}

[[operations]]
include-operation-id = "deleteRun"
parameters = {{ "path.run" = "{other_run}" }}

[[operations]]
include-operation-id = "deleteModel"
parameters = {{ "path.version" = 2 }}

[[operations]]
include-operation-id = "docsAsset"
parameters = {{ "path.asset" = "swagger-ui.css" }}
""")
