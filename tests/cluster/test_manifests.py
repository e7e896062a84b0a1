"""docker/: what can be checked without Docker or Kubernetes.

The compose file is checked against the Compose Specification's schema as the package compose-viz ships it (skipped
where that is not installed). No package ships the schema of KubeRay's RayJob: its structure is checked by hand here, by
the fields that KubeRay 1.6's reference names.
"""

import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
DOCKER = ROOT / "docker"


@pytest.fixture(scope="module")
def compose():
    return yaml.safe_load((DOCKER / "compose.yaml").read_text())


@pytest.fixture(scope="module")
def rayjob():
    (job,) = [d for d in yaml.safe_load_all((DOCKER / "rayjob.yaml").read_text()) if d["kind"] == "RayJob"]
    return job


def containers(job):
    cluster = job["spec"]["rayClusterSpec"]
    groups = [cluster["headGroupSpec"], *cluster["workerGroupSpecs"]]
    return [(group, container) for group in groups for container in group["template"]["spec"]["containers"]]


def test_compose_file_against_the_specification(compose):
    specification = pytest.importorskip("compose_viz.spec.compose_spec", reason="compose-viz is not installed")
    # the specification allows keys that begin with x- here; the package's model of it does not
    content = {key: value for key, value in compose.items() if not key.startswith("x-")}
    parsed = specification.ComposeSpecification.model_validate(content)
    assert set(parsed.services) == set(compose["services"])


def test_nothing_in_the_compose_file_starts_without_secrets_of_its_user(compose):
    """Every variable that names a secret has no default but `:?`, and no secret stands in the file."""
    text = (DOCKER / "compose.yaml").read_text()
    for name, rest in re.findall(r"\$\{(\w*(?:TOKEN|PASSWORD|SECRET)\w*)([^}]*)\}", text):
        assert rest.startswith(":?"), name
    for service, content in compose["services"].items():
        for key, value in (content.get("environment") or {}).items():
            if re.search("TOKEN|PASSWORD|SECRET", key):
                assert str(value).startswith("${"), f"{service}: {key}"
    assert "${RAY_AUTH_TOKEN:?" in text and "${POSTGRES_PASSWORD:?" in text


def test_ports_of_the_compose_file_are_published_on_this_machine_only(compose):
    ports = [port for service in compose["services"].values() for port in service.get("ports", [])]
    assert len(ports) == 2 and all(port.startswith("127.0.0.1:") for port in ports)
    assert compose["networks"]["database"]["internal"] and compose["services"]["postgres"]["networks"] == ["database"]


def test_compose_services_fit_together(compose):
    services = compose["services"]
    assert set(services) == {"head", "worker", "mlflow", "postgres"}
    for name, service in services.items():
        assert set(service.get("depends_on", {})) <= set(services), name
        for volume in service["volumes"]:
            assert volume.split(":")[0] in compose["volumes"], name
        assert set(service["networks"]) <= set(compose["networks"]), name
        target = service.get("build", {}).get("target")
        assert target is None or f" AS {target}\n" in (DOCKER / "Dockerfile").read_text()
    for name in ("head", "worker"):
        assert services[name]["environment"]["RAY_AUTH_MODE"] == "token"
        assert services[name]["environment"]["MLFLOW_TRACKING_URI"] == "http://mlflow:5000"


def test_the_rayjob_has_the_fields_that_kuberay_knows(rayjob):
    assert rayjob["apiVersion"] == "ray.io/v1"
    known = {"entrypoint", "submissionMode", "backoffLimit", "shutdownAfterJobFinishes", "ttlSecondsAfterFinished"}
    assert set(rayjob["spec"]) == known | {"rayClusterSpec"}
    cluster = rayjob["spec"]["rayClusterSpec"]
    assert set(cluster) == {"rayVersion", "authOptions", "headGroupSpec", "workerGroupSpecs"}
    assert set(cluster["headGroupSpec"]) == {"rayStartParams", "template"}
    for group in cluster["workerGroupSpecs"]:
        assert set(group) == {"groupName", "replicas", "minReplicas", "maxReplicas", "rayStartParams", "template"}
        assert group["minReplicas"] <= group["replicas"] <= group["maxReplicas"]
    for group, container in containers(rayjob):
        assert all(isinstance(value, str) for value in group["rayStartParams"].values())
        volumes = {volume["name"] for volume in group["template"]["spec"]["volumes"]}
        assert {mount["name"] for mount in container["volumeMounts"]} <= volumes
        # a raylet must not hold more CPUs than its container has
        assert int(group["rayStartParams"]["num-cpus"]) <= int(container["resources"]["limits"]["cpu"])
        assert "/shared" in {mount["mountPath"] for mount in container["volumeMounts"]}


def test_the_rayjob_runs_as_nobody_special_with_secrets_from_secrets(rayjob):
    assert rayjob["spec"]["rayClusterSpec"]["authOptions"] == {"mode": "token", "secretName": "segue-ray"}
    for group, container in containers(rayjob):
        assert group["template"]["spec"]["securityContext"]["runAsNonRoot"] is True
        assert container["securityContext"]["allowPrivilegeEscalation"] is False
        assert all("secretKeyRef" in entry["valueFrom"] for entry in container["env"])


def test_the_entrypoint_is_a_command_that_this_version_understands(rayjob):
    from orchestrator.plan import read_plan
    from orchestrator.settings import command_line

    words = rayjob["spec"]["entrypoint"].split()
    assert words[:3] == ["python", "-m", "orchestrator.sweep"]
    plan = read_plan(ROOT / words[3], command_line(words[4:]))
    assert plan.out.is_relative_to("/shared")
    version = rayjob["spec"]["rayClusterSpec"]["rayVersion"]
    assert f"ray=={version}\n" in (ROOT / "constraints.txt").read_text()
    # the workers of one run fit on the workers' machines
    cpus = sum(int(g["rayStartParams"]["num-cpus"]) * g.get("replicas", 1) for g, _ in containers(rayjob))
    assert plan.runs[0].config.num_workers * plan.runs[0].config.worker_threads < cpus


def test_the_image_is_pinned_and_runs_as_a_user_of_its_own():
    text = (DOCKER / "Dockerfile").read_text()
    (base,) = re.findall(r"^ARG PYTHON=(.+)$", text, re.MULTILINE)
    assert re.fullmatch(r"3\.\d+\.\d+-slim-\w+", base)
    assert re.findall(r"^FROM (.+) AS", text, re.MULTILINE) == ["python:${PYTHON}"] * 2
    for stage in text.split("\nFROM ")[1:]:
        assert re.findall(r"^USER (.+)$", stage, re.MULTILINE)[-1] != "root"
        assert "HEALTHCHECK" in stage and "-c constraints.txt" in stage
        assert not re.search(r"(PASSWORD|TOKEN|SECRET)=", stage)
