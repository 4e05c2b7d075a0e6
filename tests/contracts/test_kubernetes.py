"""What docs/kubernetes.md has a cluster run: jobs as Prefect's own worker makes them, held against Kubernetes' API.

Without a cluster: that it runs them is not tested.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

pytest.importorskip("prefect_kubernetes", reason="the extra `kubernetes` is not installed")
pytestmark = pytest.mark.filterwarnings("default")  # theirs

from kubernetes_asyncio import client  # noqa: E402
from prefect.client.schemas import FlowRun  # noqa: E402
from prefect.utilities.schema_tools import ValidationError, validate  # noqa: E402
from prefect.utilities.templating import apply_values  # noqa: E402
from prefect_kubernetes.worker import KubernetesWorkerJobConfiguration  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "kubernetes"
PAGE = (ROOT / "docs" / "kubernetes.md").read_text(encoding="utf-8")
TEMPLATE = json.loads((FOLDER / "job_template.json").read_text(encoding="utf-8"))
IMAGE = "registry.example/ctlev:1"


def job(**variables):
    """The manifest that the worker would send, of a run whose deployment has these job variables."""
    described = TEMPLATE["variables"]["properties"]
    defaults = {name: field["default"] for name, field in described.items() if "default" in field}
    # As `from_template_and_values`, which would ask a server for blocks that the template might name.
    filled = apply_values(TEMPLATE["job_configuration"], {**defaults, "image": IMAGE, **variables})
    made = KubernetesWorkerJobConfiguration(**filled)
    made.prepare_for_flow_run(FlowRun(flow_id="00000000-0000-0000-0000-000000000000", name="brave-crow"))
    return made.job_manifest


def unknown_fields(value, model, where):
    """Names in a manifest that a type of Kubernetes' API does not have; `model` as its client names types."""
    if found := re.fullmatch(r"(?:list\[|dict\(str, )(.*)[\])]", model):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return [name for key, item in items for name in unknown_fields(item, found[1], f"{where}.{key}")]
    kind = getattr(client, model, None)
    if kind is None:
        expected = {"str": str, "int": int, "bool": bool, "object": object}[model]
        assert isinstance(value, expected), f"{where}: expected {model}, got {value!r}"
        return []
    types = {kind.attribute_map[name]: of for name, of in kind.openapi_types.items()}
    missing = [name for name in value if name not in types]
    further = [(name, item) for name, item in value.items() if name in types]
    found = [name for key, item in further for name in unknown_fields(item, types[key], f"{where}.{key}")]
    return [f"{where}.{name}" for name in missing] + found


def test_jobs_are_what_kubernetes_takes():
    made = job()
    assert unknown_fields(made, "V1Job", "job") == []
    assert unknown_fields({"spec": {"nodes": 1}}, "V1Job", "job") == ["job.spec.nodes"], "or nothing would be found"
    (container,) = made["spec"]["template"]["spec"]["containers"]
    assert container["image"] == IMAGE and container["args"] == ["prefect", "flow-run", "execute"]
    assert container["resources"] == {
        "requests": {"cpu": "4", "memory": "16Gi"}, "limits": {"memory": "16Gi", "nvidia.com/gpu": "0"},
    }  # fmt: skip
    assert {"PREFECT__FLOW_RUN_ID"} <= {one["name"] for one in container["env"]}


def test_every_variable_changes_the_job_and_none_is_left_open():
    plain = json.dumps(job())
    assert "{{" not in plain
    values = {"integer": 77, "object": {"CHANGED": "changed"}, "string": "changed"}
    for name, described in TEMPLATE["variables"]["properties"].items():
        if "job_watch" in name or "pod_watch" in name:
            continue  # of the worker, not of the job
        value = "Always" if "enum" in described else values[described["type"]]
        assert json.dumps(job(**{name: value})) != plain, name


def test_an_image_must_be_said():
    """By Prefect's own check, which refuses a run without it."""
    with pytest.raises(ValidationError, match="'image' is a required property"):
        validate({"gpus": "1"}, TEMPLATE["variables"], raise_on_error=True)
    validate({"image": IMAGE}, TEMPLATE["variables"], raise_on_error=True)


def test_claims_of_the_volumes_are_those_that_jobs_mount():
    claims = list(yaml.safe_load_all((FOLDER / "volumes.yaml").read_text(encoding="utf-8")))
    for claim in claims:
        assert unknown_fields(claim, f"V1{claim['kind']}", claim["metadata"]["name"]) == []
    mounted = job()["spec"]["template"]["spec"]["volumes"]
    named = {volume["persistentVolumeClaim"]["claimName"] for volume in mounted if "persistentVolumeClaim" in volume}
    assert named == {claim["metadata"]["name"] for claim in claims}


def test_the_image_has_what_jobs_need():
    text = (FOLDER / "Dockerfile").read_text(encoding="utf-8")
    (container,) = job()["spec"]["template"]["spec"]["containers"]
    places = {mount["name"]: mount["mountPath"] for mount in container["volumeMounts"]}
    assert f"WORKDIR {container['workingDir']}\n" in text
    assert f"ENV CTLEV_HOME={places['store']}\n" in text and f"mkdir -p {places['data']} {places['store']}" in text
    assert "constraints.txt -e '.[bucket]'" in text and (ROOT / "constraints.txt").is_file()


def test_the_page_names_files_and_variables_that_there_are():
    for name in re.findall(r"docs/kubernetes/[\w.]+", PAGE):
        assert (ROOT / name).is_file(), name
    for name in re.findall(r"--job-variable (\w+)=", PAGE) + re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE):
        assert name in TEMPLATE["variables"]["properties"], name
    assert set(TEMPLATE["variables"]["properties"]) - set(re.findall(r"`(\w+)`", PAGE)) <= {"command", "labels", "name"}


@pytest.mark.slow
def test_prefect_makes_a_pool_of_the_template(tmp_path):
    """Prefect's own check of templates; the server is one of this test."""
    environment = {
        "PREFECT_HOME": str(tmp_path), "PATH": str(Path(shutil.which("prefect")).parent) + ":/usr/bin:/bin",
        "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "300",
    }  # fmt: skip
    command = ["prefect", "--no-prompt", "work-pool", "create", "ctlev", "--type", "kubernetes"]
    template = ["--base-job-template", str(FOLDER / "job_template.json")]
    finished = subprocess.run([*command, *template], env=environment, capture_output=True, text=True, timeout=300)
    assert finished.returncode == 0, finished.stdout + finished.stderr
    assert "Created work pool 'ctlev'" in finished.stdout
