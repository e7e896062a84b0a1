"""Self-Behavior Cloning: pairs against Algorithm 1's exhaustive store, demonstrations against the reference."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import reference
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation

from learner import sbc
from learner.config import SBCConfig
from learner.state import LearnerState
from learner.update import update
from motion import skeleton
from workers.action import decode
from workers.rollout import Rollout
from workers.types import CONTINUES, FELL, REACHED, TIMED_OUT


def stored(pairs):
    """Pairs as a set of (t, k, environment)."""
    return set(zip(pairs.step.tolist(), (pairs.target + 1).tolist(), pairs.column.tolist(), strict=True))


def exhaustive(pose, next_pose, end):
    return {
        (t, k, i)
        for i in range(end.shape[1])
        for t, k in reference.sbc_store(pose[:, i, :3].astype(float), next_pose[:, i, :3].astype(float), end[:, i] != 0)
    }


def walk(seed, horizon, n, share):
    """A made-up chunk: roots walk at random, and jump elsewhere where an episode ended."""
    generator = np.random.default_rng(seed)
    end = np.where(generator.random((horizon, n)) < share, generator.integers(1, 4, (horizon, n)), CONTINUES)
    pose, next_pose = np.empty((2, horizon, n, 84), dtype=np.float32)
    here = generator.normal(size=(n, 84))
    for t in range(horizon):
        pose[t] = here
        here = here + generator.normal(size=(n, 84))
        next_pose[t] = here
        here = np.where(end[t][:, None] != 0, 5 * generator.normal(size=(n, 84)), here)
    return pose, next_pose, end.astype(np.int8)


@given(seed=st.integers(0, 2**32 - 1), horizon=st.integers(1, 9), share=st.sampled_from([0.0, 0.15, 0.5, 1.0]))
def test_valid_pairs_are_algorithm_1s_store_on_random_trajectories(seed, horizon, share):
    chunk = walk(seed, horizon, 4, share)
    assert stored(sbc.valid_pairs(*chunk)) == exhaustive(*chunk)


def assert_pairs_are_the_store(chunks):
    for chunk in chunks:
        pairs = sbc.valid_pairs(chunk.pose, chunk.next_pose, chunk.end)
        assert len(stored(pairs)) == len(pairs)
        assert stored(pairs) == exhaustive(chunk.pose, chunk.next_pose, chunk.end)
        assert {(t, k) for t, k, _ in stored(pairs)} > {(0, 1), (0, 8), (7, 8)}


def test_valid_pairs_are_algorithm_1s_store_on_rollouts(lessons):
    assert_pairs_are_the_store(lessons)


def test_valid_pairs_are_algorithm_1s_store_on_rollouts_between_real_clips(
    real_library, make_config, make_policy, easy
):
    rollout = Rollout(make_config({"task.max_steps": 16}), real_library, 24, 8, seed=0)
    chunk, _ = rollout.collect(rollout.initial_state(0), make_policy(), easy)
    assert_pairs_are_the_store([chunk])


@pytest.mark.parametrize("end", [REACHED, FELL, TIMED_OUT])
def test_the_last_pose_of_an_episode_is_a_target_and_nothing_beyond_it(end):
    """A root that walks straight ahead for 6 steps; an episode ends with the third."""
    at = np.zeros((6, 1, 84), dtype=np.float32)
    at[:, 0, 0] = np.arange(6)
    ends = np.zeros((6, 1), dtype=np.int8)
    ends[2] = end
    pairs = stored(sbc.valid_pairs(at, at + np.float32([1] + [0] * 83), ends))
    assert pairs == {(t, k, 0) for a, b in ((0, 3), (3, 6)) for t in range(a, b) for k in range(t + 1, b + 1)}


def test_a_step_away_from_the_later_pose_is_no_demonstration():
    """There and back: the first step leads away from where the second one ends."""
    at = np.zeros((2, 1, 84), dtype=np.float32)
    at[1, 0, 0] = 1.0
    after = np.zeros_like(at)
    after[0, 0, 0] = 1.0
    assert stored(sbc.valid_pairs(at, after, np.zeros((2, 1), np.int8))) == {(0, 1, 0), (1, 2, 0)}


def test_a_root_that_stands_still_demonstrates_nothing():
    still = np.ones((5, 3, 84), dtype=np.float32)
    assert len(sbc.valid_pairs(still, still, np.zeros((5, 3), np.int8))) == 0


def test_an_update_draws_pairs_as_from_the_exhaustive_store(lessons, columns, make_config, monkeypatch):
    """Chi-square of some 20 000 draws over all pairs, one update's own random numbers."""
    chunk = columns(lessons[2], range(4))
    config = make_config({"sbc.batch_size": 10_000, "ppo.minibatch_size": 32, "ppo.epochs": 2})
    drawn, original = Counter(), sbc.demonstrations

    def spy(chunk, pairs, chosen, action):
        drawn.update(
            zip(
                pairs.step[chosen].tolist(),
                (pairs.target[chosen] + 1).tolist(),
                pairs.column[chosen].tolist(),
                strict=True,
            )
        )
        return original(chunk, pairs, chosen, action)

    monkeypatch.setattr(sbc, "demonstrations", spy)
    update(LearnerState(config, seed=2), [chunk])
    store = exhaustive(chunk.pose, chunk.next_pose, chunk.end)
    assert set(drawn) == store and len(store) > 50
    counts = [drawn[pair] for pair in sorted(store)]
    assert sum(counts) == 2 * 10_000 * 1  # 4 environments * 8 steps: one minibatch per epoch
    assert stats.chisquare(counts).pvalue > 1e-4


@pytest.fixture(scope="module")
def drawn(lessons):
    """(chunk, pairs, numbers of 40 pairs of all gaps)."""
    chunk = lessons[2]
    pairs = sbc.valid_pairs(chunk.pose, chunk.next_pose, chunk.end)
    return chunk, pairs, np.random.default_rng(0).integers(len(pairs), size=40)


@pytest.mark.parametrize("target", ["absolute", "difference"])
def test_a_demonstration_observes_p_t_with_p_k_as_its_target(target, drawn, make_config):
    chunk, pairs, chosen = drawn
    difference = target == "difference"
    observation, _ = sbc.demonstrations(chunk, pairs, chosen, make_config({"observation.target": target}))
    assert observation.shape == (40, 282) and observation.dtype == np.float32
    for row, m in zip(observation, chosen, strict=True):
        pose = chunk.pose[pairs.step[m], pairs.column[m]].astype(float)
        target = chunk.next_pose[pairs.target[m], pairs.column[m]].astype(float)
        wanted = reference.observation(pose[:47], pose[47:], target[:47], target[47:], difference)
        np.testing.assert_allclose(row, wanted, rtol=1e-5, atol=1e-4)


def assert_same_rotations(a, b, atol=2e-4):
    for joint, start in zip(skeleton.JOINTS, skeleton.JOINT_DOF, strict=True):
        part = slice(start, start + joint.dof)
        if joint.dof == 3:
            assert (Rotation.from_rotvec(a[part]).inv() * Rotation.from_rotvec(b[part])).magnitude() < atol
        else:
            np.testing.assert_allclose(a[part], b[part], atol=atol)


@pytest.mark.parametrize("mode", ["absolute", "target", "current"])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_a_demonstrated_action_aims_the_controllers_where_the_step_did(mode, scale, drawn, make_config):
    """Expressed around the retargeted pose in mode `target`, it decodes to the same PD target there."""
    chunk, pairs, chosen = drawn
    config = make_config({"action.mode": mode, "action.scale": scale})
    _, action = sbc.demonstrations(chunk, pairs, chosen, config)
    for row, m in zip(action, chosen, strict=True):
        step, target, column = pairs.step[m], pairs.target[m], pairs.column[m]
        base = {"target": chunk.next_pose[target, column], "current": chunk.pose[step, column]}
        base = base.get(mode, np.full(84, np.nan))[:47].astype(float)
        got = np.empty(31)
        decode(row.astype(float), base, scale, mode == "absolute", got)
        assert_same_rotations(got, chunk.pd_target[step, column].astype(float))


def test_without_an_offset_the_demonstrated_action_is_the_action_taken(library, make_config, make_policy, easy):
    config = make_config({"action.mode": "absolute", "action.scale": 0.7})
    rollout = Rollout(config, library, 8, 8, seed=0)
    chunk, _ = rollout.collect(rollout.initial_state(0), make_policy(), easy)
    pairs = sbc.valid_pairs(chunk.pose, chunk.next_pose, chunk.end)
    chosen = np.arange(len(pairs))
    _, action = sbc.demonstrations(chunk, pairs, chosen, config)
    np.testing.assert_allclose(action, chunk.action[pairs.step, pairs.column], atol=1e-5)


@pytest.mark.parametrize("kind", ["balanced", "inverse", "uniform"])
def test_gap_weights_are_those_of_equation_17(kind):
    gaps = np.arange(1, 17)
    got = sbc.gap_weights(gaps, 17, kind)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, [reference.gap_weight(kind, gap, 17) for gap in gaps], rtol=1e-6)


def test_balanced_weights_give_every_gap_the_same_share_of_an_uninterrupted_trajectory():
    at = np.zeros((16, 1, 84), dtype=np.float32)
    at[:, 0, 0] = np.arange(16)
    pairs = sbc.valid_pairs(at, at + np.float32([1] + [0] * 83), np.zeros((16, 1), np.int8))
    weight = sbc.gap_weights(pairs.gap(), 17, "balanced")
    shares = [weight[pairs.gap() == gap].sum() for gap in range(1, 17)]
    np.testing.assert_allclose(shares, 16.0, rtol=1e-5)


@pytest.mark.parametrize("kind", ["balanced", "inverse", "uniform"])
def test_an_update_weighs_by_the_trajectorys_poses(kind, lessons, make_config, monkeypatch):
    """T of Eq. 17 counts poses: a chunk of 8 steps has 9."""
    seen, original = [], sbc.sbc_loss

    def spy(mean, action, weight, config):
        seen.append(weight.numpy().copy())
        return original(mean, action, weight, config)

    monkeypatch.setattr(sbc, "sbc_loss", spy)
    config = make_config({"sbc.gap_weighting": kind, "ppo.epochs": 1})
    update(LearnerState(config, seed=2), [lessons[0]])
    wanted = {np.float32(reference.gap_weight(kind, gap, 9)) for gap in range(1, 9)}
    assert set(np.concatenate(seen)) == wanted


def test_the_loss_is_equation_17():
    generator = torch.Generator().manual_seed(0)
    mean, action = torch.randn(2, 10, 31, generator=generator)
    weight = torch.rand(10, generator=generator)
    config = SBCConfig()
    slow = sum(
        float(g) * sum((a - m) ** 2 for a, m in zip(row.tolist(), own.tolist(), strict=True))
        for g, row, own in zip(weight, action, mean, strict=True)
    )
    assert sbc.sbc_loss(mean, action, weight, config).item() == pytest.approx(0.533 * slow, rel=1e-5)
    config = replace(config, reduction="mean", weight=2.0)
    assert sbc.sbc_loss(mean, action, weight, config).item() == pytest.approx(2.0 * slow / 10, rel=1e-5)
