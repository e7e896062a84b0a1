"""The Gymnasium adaptor gives the numbers of a rollout, to the bit, by Gymnasium's rules."""

import warnings

import numpy as np
import pytest

from workers.environment import Environment
from workers.types import CONTINUES, FELL, REACHED, TIMED_OUT, concatenate_outcomes

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode, SyncVectorEnv  # noqa: E402

from workers.vector_env import TransitionVectorEnv  # noqa: E402

SHORT = {"task.max_steps": 6}  # so that episodes end in every way within few steps


class SingleEnv(gymnasium.Env):
    """One of the adaptor's environments by Gymnasium's interface for single ones, which its checker understands."""

    metadata = {"render_modes": []}

    def __init__(self, config, thresholds, first=0):
        self._vector = TransitionVectorEnv(config, thresholds, 1, first=first, autoreset_mode=AutoresetMode.NEXT_STEP)
        self.observation_space = self._vector.single_observation_space
        self.action_space = self._vector.single_action_space
        self._over = False

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if self._over and seed is None:  # a failed task may be kept, which only an episode that follows it can be
            observation, _, _, _, _ = self._vector.step(np.zeros(self._vector.action_space.shape))
        else:
            observation, _ = self._vector.reset(seed=seed)
        self._over = False
        return observation[0], {}

    def step(self, action):
        observation, reward, terminated, truncated, infos = self._vector.step(action[None])
        self._over = bool(terminated[0])
        info = {name: values[0].item() for name, values in infos.items() if not name.startswith("_")}
        return observation[0], float(reward[0]), self._over, bool(truncated[0]), info


@pytest.fixture(scope="module")
def actions():
    """A function giving actions (steps, n, 31) between holding the target pose and thrashing."""

    def draw(steps, n, seed=0):
        generator = np.random.default_rng(seed)
        return generator.normal(size=(steps, n, 31), scale=np.linspace(0.05, 1.5, n)[:, None]).astype(np.float32)

    return draw


def play(env, actions):
    """What a reset and the given actions return, as a list."""
    return [env.reset(), *(env.step(action) for action in actions)]


def test_steps_are_those_of_a_rollout_to_the_bit(trajectories, easy):
    """Fed a rollout's actions, the adaptor observes, rewards and ends as that rollout did, and says so in its infos."""
    env = TransitionVectorEnv(trajectories.config, easy, 24, threads=2)
    observation, _ = env.reset(seed=5)
    final = []
    for chunk in trajectories.chunks:
        for t, action in enumerate(chunk.action):
            np.testing.assert_array_equal(observation, chunk.observation[t])
            observation, reward, terminated, truncated, infos = env.step(action)
            np.testing.assert_array_equal(reward.astype(np.float32), chunk.reward[t])
            np.testing.assert_array_equal(terminated, chunk.end[t] != CONTINUES)
            assert not truncated.any() and bool(infos) == terminated.any()
            if terminated.any():
                final.append((np.stack(list(infos["final_obs"][terminated])), infos["final_info"], terminated))
        np.testing.assert_array_equal(observation, chunk.last_observation)
    whole = concatenate_outcomes([chunk.outcomes for chunk in trajectories.chunks])
    np.testing.assert_array_equal(
        np.concatenate([rows for rows, _, _ in final]),
        np.concatenate([chunk.final_observation for chunk in trajectories.chunks]),
    )
    assert set(whole.end) == {REACHED, FELL, TIMED_OUT}
    for name, wanted in (
        ("reached", whole.end == REACHED), ("retained", whole.retained),
        ("steps", whole.steps),
    ):  # fmt: skip
        np.testing.assert_array_equal(np.concatenate([info[name][ended] for _, info, ended in final]), wanted, name)
    # numpy adds the seven parts in another order where they lie in another array
    returns = np.concatenate([info["return"][ended] for _, info, ended in final])
    np.testing.assert_allclose(returns, whole.parts.sum(axis=1), rtol=1e-14)


def test_physics_is_that_of_the_environment_alone(library, make_config, actions, easy):
    """Until its first end, an environment of the adaptor sees what `Environment` does with the same task."""
    config = make_config(SHORT)
    env = TransitionVectorEnv(config, easy, 6, first=3)
    observation, _ = env.reset()
    alone = Environment(config, library, 6)
    alone.plan(config.seed, np.arange(3, 9), np.full(6, -1), np.arange(6))
    alone.begin(np.arange(6))
    running = np.ones(6, dtype=bool)
    for action in actions(6, 6):
        np.testing.assert_array_equal(observation[running], alone.observe(np.empty((6, 282), np.float32))[running])
        observation, reward, terminated, _, _ = env.step(action)
        alone.step(action, easy)
        np.testing.assert_array_equal(reward[running], alone.parts.sum(axis=1)[running])
        np.testing.assert_array_equal(terminated[running], alone.end[running] != CONTINUES)
        running &= ~terminated
    assert not running.any()


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_it_behaves_as_gymnasiums_own_vector_of_single_environments(
    mode, make_config, actions, easy, assert_same_bits
):
    """`SyncVectorEnv`, Gymnasium's reference, of the same tasks: every value, type, shape and info of both modes."""
    config = make_config(SHORT)
    vector = TransitionVectorEnv(config, easy, 5, autoreset_mode=mode)
    reference = SyncVectorEnv([lambda i=i: SingleEnv(config, easy, i) for i in range(5)], autoreset_mode=mode)
    for space in ("observation_space", "action_space", "single_observation_space", "single_action_space"):
        assert getattr(vector, space) == getattr(reference, space)
    assert vector.metadata["autoreset_mode"] == mode
    reference.reset(seed=[7] * 5)
    vector.reset(seed=7)
    ended = waited = 0
    for action in actions(40, 5):
        one, other = vector.step(action), reference.step(action)
        for infos in (one[4], other[4]):
            if "final_obs" in infos:
                infos["final_obs"] = list(infos["final_obs"])
        assert_same_bits(list(one), list(other))
        waited += int(((one[1] == 0) & ~one[2]).sum())
        ended += int(one[2].sum())
    assert ended > 20
    assert waited == (0 if mode == AutoresetMode.SAME_STEP else pytest.approx(ended, abs=5))


def test_gymnasiums_checker_finds_no_error(make_config, easy):
    """Its warnings are about spaces without bounds, which observations in metres do not have, and about rendering."""
    gymnasium.register("Transition-v0", lambda: SingleEnv(make_config(SHORT), easy))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(gymnasium.make("Transition-v0", disable_env_checker=True).unwrapped)
    texts = [str(warning.message) for warning in caught if issubclass(warning.category, UserWarning)]
    assert texts and all("infinity" in text or "normalized" in text or "render" in text for text in texts), texts


def test_returned_arrays_lie_in_the_spaces_and_are_not_written_to_again(make_config, actions, easy):
    env = TransitionVectorEnv(make_config(SHORT), easy, 4)
    kept = play(env, actions(8, 4))
    copies = [tuple(np.array(x) for x in step[:-1]) for step in kept]
    for action in actions(8, 4, seed=1):
        env.step(action)
    for step, copy in zip(kept, copies, strict=True):
        assert step[0] in env.observation_space
        for before, after in zip(copy, step[:-1], strict=True):
            np.testing.assert_array_equal(before, after)
    assert env.action_space.sample() in env.action_space and env.action_space.shape == (4, 31)


def test_a_seed_repeats_the_tasks_and_another_seed_draws_others(make_config, actions, easy, assert_same_bits):
    env = TransitionVectorEnv(make_config(SHORT), easy, 4)

    def episodes(seed):
        first, _ = env.reset(seed=seed)
        return {"first": first} | {str(t): env.step(action)[0] for t, action in enumerate(actions(14, 4))}

    one, other, again = episodes(1), episodes(2), episodes(1)
    assert_same_bits(one, again)
    for name in ("first", "13"):  # after 14 steps of episodes of at most 6 every environment has begun others
        assert (one[name] != other[name]).any(axis=1).all()
    went_on, _ = env.reset()
    assert (went_on != one["first"]).any(axis=1).all()


def test_a_mode_without_autoreset_is_refused(make_config, easy):
    with pytest.raises(ValueError, match="SAME_STEP or NEXT_STEP"):
        TransitionVectorEnv(make_config(), easy, 2, autoreset_mode=AutoresetMode.DISABLED)
