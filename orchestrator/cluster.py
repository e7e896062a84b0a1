"""Ray: connect to a cluster or start one here, and what a run asks of it."""

import logging
import os
import shutil
import sys

# Before Ray starts its processes. Its own niceness of 15 lets actors starve beside anything else that the machine does.
os.environ.setdefault("RAY_worker_niceness", "0")
# A lost actor fails what waits for it, which is met where it is waited for: no need to print the rest
os.environ.setdefault("RAY_IGNORE_UNHANDLED_ERRORS", "1")

import ray  # noqa: E402

from motion.errors import InputError  # noqa: E402

LOCAL_OBJECT_STORE = 512 * 1024**2  # bytes, at least; shared memory is only touched as it is used
BYTES_PER_SAMPLE = 4096  # of a chunk in the object store: observations, actions, poses as float32
CHUNKS_IN_FLIGHT = 8
TRIES = 3  # to start a cluster here


def connect(samples_per_iteration):
    """Join the cluster of RAY_ADDRESS (set for jobs of `ray job submit`), else start one on this machine, quietly.

    samples_per_iteration: size of the chunks that the object store must hold. InputError if no cluster answers.
    """
    address = os.environ.get("RAY_ADDRESS")
    quiet = {"log_to_driver": False, "logging_level": logging.ERROR, "configure_logging": True}
    if address:
        try:
            ray.init(address="auto", **quiet)
        except (ConnectionError, RuntimeError) as error:
            raise InputError(
                f"RAY_ADDRESS={address}: no Ray cluster answers ({str(error).splitlines()[0]}); "
                "start it, set RAY_AUTH_MODE and RAY_AUTH_TOKEN as where it was started, or unset RAY_ADDRESS to run "
                "on this machine"
            ) from error
    else:
        size = max(LOCAL_OBJECT_STORE, samples_per_iteration * BYTES_PER_SAMPLE * CHUNKS_IN_FLIGHT)
        start_here(include_dashboard=False, object_store_memory=fitting_store(size), **quiet)


def start_here(**options):
    """Start a cluster on this machine. Tried again: on a busy one, parts that wait for each other give up too early."""
    for left in reversed(range(TRIES)):
        try:
            ray.init(address="local", **options)
            return
        except Exception as error:  # Ray raises no narrower class
            ray.shutdown()
            if "timed out during startup" not in str(error):
                raise
            if not left:
                raise InputError(
                    f"Ray did not start in {TRIES} tries: this machine is too busy; try again when less is running, "
                    "or use runtime=local, which needs no Ray (one run: python -m orchestrator.train)"
                ) from error
            print(f"Ray did not start in time; {left} more tries", file=sys.stderr)


def fitting_store(size):
    """`size` bytes, less where this machine's shared memory (small in containers) does not hold them."""
    if os.path.isdir("/dev/shm"):
        size = min(size, int(shutil.disk_usage("/dev/shm").free * 0.9))
    return max(size, 80 * 1024**2)  # Ray refuses less than 75 MiB


def resolve_device(device, runtime):
    """`cuda` or `cpu` for `auto`: whether the cluster, or with `local` this machine, has a GPU for the learner."""
    if device != "auto":
        return device
    if runtime == "ray" and ray.cluster_resources().get("GPU", 0) < 1:
        return "cpu"
    if runtime == "ray" and os.environ.get("RAY_ADDRESS"):
        return "cuda"
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def bundles(config):
    """Resources of a run as one dict per actor: learner, then each worker; with runtime=local one for all."""
    gpu = {"GPU": 1} if config.device == "cuda" else {}
    if config.runtime == "local":
        return [{"CPU": 1, **gpu}]
    return [{"CPU": config.learner_threads, **gpu}] + [{"CPU": config.worker_threads}] * config.num_workers


def placeable(wanted, nodes):
    """Whether resource dicts `wanted` fit on idle `nodes` (each a dict), placed largest first where they fit first."""
    free = [dict(node) for node in nodes]
    for bundle in sorted(wanted, key=lambda b: (b.get("GPU", 0), b.get("CPU", 0)), reverse=True):
        home = next((node for node in free if all(node.get(k, 0) >= v for k, v in bundle.items())), None)
        if home is None:
            return False
        for key, value in bundle.items():
            home[key] -= value
    return True


def alive_nodes():
    """Resources of each node of the cluster."""
    return [node["Resources"] for node in ray.nodes() if node["Alive"]]


def check_placeable(config, nodes):
    """InputError unless a run of `config` can ever be placed on `nodes`, saying what it needs and what there is."""
    wanted = bundles(config)
    if placeable(wanted, nodes):
        return
    if config.runtime == "local":
        needs, remedy = "runtime=local", "add a machine"
    else:
        workers = f"num_workers={config.num_workers} x worker_threads={config.worker_threads}"
        needs = f"learner_threads={config.learner_threads}, {workers}"
        remedy = "lower num_workers or worker_threads, or use runtime=local"
    if config.device == "cuda" and not any(node.get("GPU", 0) for node in nodes):
        remedy = "use device=cpu"
    raise InputError(f"a run asks for {amount(wanted)} ({needs}), the cluster has {amount(nodes)} in all: {remedy}")


def shortage(config):
    """What a run in progress waits for since a machine is gone, in words; None if it has all that it needs.

    Within a Tune trial the run's placement group says so, else the resources of the machines that are left.
    """
    group = ray.util.get_current_placement_group()
    wanted = bundles(config)
    if group is not None:
        if ray.util.placement_group_table(group)["state"] == "CREATED":
            return None
    elif placeable(wanted, alive_nodes()):
        return None
    return f"{amount(wanted)}, the cluster has {amount(alive_nodes())} in all: start a machine"


def amount(resources):
    """CPUs and GPUs of resource dicts in words, with the number of machines if they are more than one."""
    cpus, gpus = (sum(r.get(key, 0) for r in resources) for key in ("CPU", "GPU"))
    return f"{cpus:g} CPU{'s' * (cpus != 1)}" + (f" and {gpus:g} GPU{'s' * (gpus != 1)}" if gpus else "")


def concurrent(config, nodes):
    """How many runs of `config` the cluster can do at a time."""
    wanted, count = bundles(config), 0
    while count < 1000 and placeable(wanted * (count + 1), nodes):
        count += 1
    return max(count, 1)
