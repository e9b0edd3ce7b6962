"""Uses the client that openapi-python-client generates from openapi.yaml, as a program of a laboratory would:

    python generated_client.py FOLDER_OF_THE_CLIENT URL

Prints `all answers are right` at the end. A test runs it with a service of its own.
"""

import io
import json
import math
import random
import sys
import time

sys.path.insert(0, sys.argv[1])

from rigcast_client import Client, models
from rigcast_client.api.fits_and_jobs import follow_job, get_job, list_jobs, start_fit
from rigcast_client.api.iterations import get_iteration, start_iteration
from rigcast_client.api.models import get_active_model, get_frf, get_weights, import_model, list_models
from rigcast_client.api.open_inference_protocol import inference_model
from rigcast_client.api.predictions import damage, predict
from rigcast_client.api.rigs import create_rig, get_rig, list_rigs, patch_rig
from rigcast_client.api.runs import get_run_data, list_runs, upload_run
from rigcast_client.api.service import live, ready
from rigcast_client.types import UNSET, File

client = Client(base_url=sys.argv[2])
RATE = 200.0


def good(answer, kind):
    assert isinstance(answer, kind), answer.to_dict() if hasattr(answer, "to_dict") else answer
    return answer


def signals(**channels):
    return models.Signals.from_dict({"sample_rate_hz": RATE, "channels": channels})


# A rig, and its name changed by a merge patch.
assert live.sync_detailed(client=client).status_code == 200
assert ready.sync_detailed(client=client, verbose=True).status_code == 200
draft = models.RigDraft.from_dict({
    "id": "bench-1", "name": "Bench", "sample_rate_hz": RATE,
    "channels": [{"name": "drive", "unit": "kN", "role": "drive"}, {"name": "disp", "unit": "mm", "role": "response"}],
})
rig = good(create_rig.sync(client=client, body=draft), models.Rig)
assert (rig.id, rig.sample_rate_hz, [c.name for c in rig.channels]) == ("bench-1", RATE, ["drive", "disp"])
tag = get_rig.sync_detailed("bench-1", client=client).headers["ETag"]
patch = models.RigPatch.from_dict({"name": "Bench with a client"})
assert good(patch_rig.sync("bench-1", client=client, body=patch, if_match=tag), models.Rig).name == "Bench with a client"
assert [rig.id for rig in list_rigs.sync(client=client).items] == ["bench-1"]

# A run as a CSV file, whose format the service finds by its bytes, and one as JSON.
random.seed(1)
drive = [random.uniform(-1.0, 1.0) for _ in range(12000)]
disp = [2.0 * a + 0.5 * b for a, b in zip(drive, [0.0, *drive])]
text = "drive,disp\n" + "".join(f"{u!r},{y!r}\n" for u, y in zip(drive, disp))
file = File(payload=io.BytesIO(text.encode()))
understood = upload_run.sync("bench-1", client=client, body=file, dry_run=True)
assert good(understood, models.UnderstoodFile).samples == 12000
file.payload.seek(0)
run = good(upload_run.sync("bench-1", client=client, body=file, name="n1", kind=models.RunKind.NOISE), models.InsertedRun)
assert run.samples == 12000 and run.duration_s == 60.0
other = good(upload_run.sync("bench-1", client=client, body=signals(drive=drive[:2000], disp=disp[:2000]),
                             split=models.Split.TEST), models.InsertedRun)
assert {item.id for item in list_runs.sync("bench-1", client=client).items} == {run.id, other.id}
data = good(get_run_data.sync("bench-1", other.id, client=client), models.Signals)
assert data.to_dict()["channels"]["disp"] == disp[:2000]

# A fit, its job, the model and its FRF.
request = models.FitRequest.from_dict({"kind": "frf", "frf": {"segment_len": 512}})
job = good(start_fit.sync("bench-1", client=client, body=request), models.Job)
deadline = time.monotonic() + 120
while job.state not in ("succeeded", "failed", "cancelled"):
    assert time.monotonic() < deadline, job.to_dict()
    time.sleep(0.1)
    job = good(get_job.sync(job.id, client=client), models.Job)
assert job.state == "succeeded", job.to_dict()
assert job.id in {item.id for item in list_jobs.sync(client=client, rig="bench-1").items}
events = follow_job.sync_detailed(job.id, client=client)
assert events.status_code == 200 and b"event: job" in events.content
version = get_active_model.sync("bench-1", client=client).version
assert version == 1 and [m.version for m in list_models.sync("bench-1", client=client).items] == [1]
frf = get_frf.sync("bench-1", version, client=client).to_dict()
gain = complex(frf["h_re"][1][0][0], frf["h_im"][1][0][0]) if "h_re" in frf else None
assert len(frf["freq_hz"]) == 257, frf.keys()

# A prediction with its figures, and the same drive's damage.
request = models.PredictRequest.from_dict({
    "drive": signals(drive=drive[:2000]).to_dict(), "target": signals(disp=disp[:2000]).to_dict(), "damage": {"slope": 3},
})
answer = good(predict.sync("bench-1", client=client, body=request), models.PredictAnswer)
response = answer.response.channels.to_dict()["disp"]
off = max(abs(a - b) for a, b in zip(response[300:1700], disp[300:1700]))
assert off < 0.05, off
assert answer.errors.channels.to_dict()["disp"]["rms"] < 0.05
assert abs(answer.damage.channels.to_dict()["disp"]["ratio"] - 1.0) < 0.1
assert answer.trust.inside == 1.0 and answer.model.version == version
counted = damage.sync(client=client, body=models.DamageRequest.from_dict({"predicted": signals(disp=response).to_dict()}))
assert good(counted, models.DamageAnswer).to_dict()["damage"]["channels"]["disp"]["predicted"] > 0.0

# An iteration, and the drive that it found.
request = models.IterationRequest.from_dict({"target": {"run": str(other.id)}, "stop": {"iterations": 2}})
job = good(start_iteration.sync("bench-1", client=client, body=request), models.Job)
while job.state not in ("succeeded", "failed", "cancelled"):
    assert time.monotonic() < deadline, job.to_dict()
    time.sleep(0.1)
    job = good(get_job.sync(job.id, client=client), models.Job)
assert job.state == "succeeded", job.to_dict()
found = get_iteration.sync("bench-1", job.result.id, client=client)
assert found.to_dict()["total_error"] < 0.2, found.to_dict()

# Weights out and in; the tensors of the Open Inference Protocol.
weights = get_weights.sync("bench-1", version, client=client)
imported = import_model.sync("bench-1", client=client, body=weights)
assert imported.to_dict()["version"] == 2, imported.to_dict()
assert inference_model.sync("bench-1", client=client).name == "bench-1"

# A refusal is a problem document with its code and its place.
wrong = models.PredictRequest.from_dict({"drive": signals(drive=[0.0], other=[0.0]).to_dict()})
refused = predict.sync_detailed("bench-1", client=client, body=wrong)
assert refused.status_code == 422
problem = good(refused.parsed, models.Problem)
assert (problem.code, problem.errors[0].channel) == ("predict.unknown_channel", "other"), problem.to_dict()

print("all answers are right")
