"""What a run asks of a cluster, and whether the cluster can ever give it."""

import pytest

from motion.errors import InputError
from orchestrator import cluster
from orchestrator.settings import build, command_line

LAPTOP = [{"CPU": 2.0}]
TWO_SMALL = [{"CPU": 2.0}, {"CPU": 2.0}]


def config_of(*arguments):
    return build([command_line(["scale=smoke", *arguments])])


def test_bundles():
    assert cluster.bundles(config_of("num_workers=2", "worker_threads=3")) == [{"CPU": 1}, {"CPU": 3}, {"CPU": 3}]
    assert cluster.bundles(config_of("runtime=local")) == [{"CPU": 1}]
    config = config_of()
    config.device = "cuda"
    assert cluster.bundles(config) == [{"CPU": 1, "GPU": 1}, {"CPU": 1}]


def test_a_bundle_must_fit_on_one_machine():
    assert cluster.placeable([{"CPU": 2}, {"CPU": 1}, {"CPU": 1}], TWO_SMALL)
    assert not cluster.placeable([{"CPU": 3}], TWO_SMALL)
    assert not cluster.placeable([{"CPU": 1}] * 5, TWO_SMALL)
    assert not cluster.placeable([{"CPU": 1, "GPU": 1}], TWO_SMALL)


def test_too_many_workers_are_refused_with_what_is_needed_and_there():
    with pytest.raises(InputError) as caught:
        cluster.check_placeable(config_of("num_workers=3"), LAPTOP)
    for words in ("asks for 4 CPUs", "num_workers=3", "cluster has 2 CPUs", "lower num_workers"):
        assert words in str(caught.value)
    cluster.check_placeable(config_of("num_workers=3"), TWO_SMALL)
    config = config_of()
    config.device = "cuda"
    with pytest.raises(InputError, match="1 GPU.*use device=cpu"):
        cluster.check_placeable(config, LAPTOP)


def test_runs_at_a_time():
    assert cluster.concurrent(config_of(), LAPTOP) == 1
    assert cluster.concurrent(config_of("runtime=local"), LAPTOP) == 2
    assert cluster.concurrent(config_of(), TWO_SMALL) == 2


def test_a_ray_that_never_starts_in_time_is_one_line_after_all_tries(monkeypatch, capsys):
    tried = []

    def init(**options):
        tried.append(options)
        raise Exception("The current node timed out during startup. This could happen because some raylet failed.")

    monkeypatch.setattr(cluster.ray, "init", init)
    with pytest.raises(InputError, match="too busy; try again.*runtime=local") as caught:
        cluster.start_here(num_cpus=1)
    assert "\n" not in str(caught.value) and len(tried) == cluster.TRIES
    assert capsys.readouterr().err.count("did not start in time") == cluster.TRIES - 1


def test_any_other_error_of_rays_start_is_not_tried_again(monkeypatch):
    def init(**options):
        raise ValueError("no such option")

    monkeypatch.setattr(cluster.ray, "init", init)
    with pytest.raises(ValueError, match="no such option"):
        cluster.start_here()
