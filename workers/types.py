"""The data that flows through a run; read this first.

    collect(worker_state, policy, thresholds) -> (chunk, worker_state)      workers.rollout
    update(learner_state, chunks)             -> (learner_state, metrics)   learner.update
    observe(curriculum_state, outcomes)       -> curriculum_state           orchestrator.curriculum

All three are pure: the result depends on the arguments and the run's configuration, on nothing else, and the arguments
are left as they were. N is the number of environments of one worker, T the horizon. Environments are named by their
index in the whole run, so their random numbers, and hence all numbers, do not depend on how workers share them.
"""

import math
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Thresholds:
    """What the curriculum broadcasts. A task is reached when every deviation is below its threshold (section 4)."""

    root_position: float
    """d^rp, m."""
    key_bodies: float
    """d^kp, m."""
    joint_rotation: float
    """d^q, rad."""
    heading: float = np.inf
    """d^rq, rad; infinite unless `reach.heading`."""
    tightenings: int = 0
    """How many times the curriculum has cut them."""
    shares: tuple = ()
    """Cumulative shares of the cells that `task.focus` draws from; empty without."""
    groups: tuple = ()
    """(d^rp, d^kp, d^q, d^rq, tightenings) of every group of tasks, in `MotionLibrary.groups`' order, where the
    curriculum keeps more than one (`curriculum.scope`); the fields above are then the loosest. Empty: all alike."""

    def of(self, group):
        """(N, 5) float64: d^rp, d^kp, d^q, d^rq and tightenings for the tasks of the groups numbered `group` (N,)."""
        if self.groups:
            return np.array(self.groups, dtype=np.float64)[group]
        alike = (self.root_position, self.key_bodies, self.joint_rotation, self.heading, self.tightenings)
        return np.tile(np.array(alike, dtype=np.float64), (len(group), 1))


@dataclass(frozen=True)
class Policy:
    """A snapshot of the policy: all that a worker needs to act. float32 arrays.

    weights, biases: one (inputs, outputs) matrix and one (outputs,) vector per layer, ReLU between.
    observation_mean, observation_scale: (282,); the network sees clip((s - mean) * scale, -10, 10).
    log_sigma: log standard deviation of every action dimension.
    version: number of updates that made it.
    noise_window, independent_from, judges, judge_log_sigma, sigma_factor: how it explores; see
    `learner.config.PolicyConfig` and `workers.noise`; judge_log_sigma is in units of the network's output, as
    log_sigma.
    average_weights, average_biases: as weights and biases, their running average; empty if none is kept.
    """

    weights: tuple
    biases: tuple
    observation_mean: np.ndarray
    observation_scale: np.ndarray
    log_sigma: float
    version: int
    noise_window: int = 1
    judges: int = 0
    judge_log_sigma: float = -3.7
    average_weights: tuple = ()
    average_biases: tuple = ()
    sigma_factor: float = 1.0
    independent_from: int | None = None

    def exploring_log_sigma(self, tightenings):
        """Log standard deviation of exploring environments' actions after so many cuts of thresholds, both (N,)."""
        if self.sigma_factor == 1.0:
            return np.full(len(tightenings), self.log_sigma)
        smallest = min(self.log_sigma, self.judge_log_sigma)
        return np.maximum(self.log_sigma + tightenings * math.log(self.sigma_factor), smallest)

    def independent(self, tightenings):
        """Whether exploring environments' noise has no window after so many cuts of thresholds, both (N,)."""
        if self.independent_from is None:
            return np.zeros(len(tightenings), dtype=bool)
        return tightenings >= self.independent_from

    def averaged(self):
        """The policy that judging environments act with and that is evaluated: of the averaged weights, if any."""
        if not self.average_weights:
            return self
        return replace(
            self, weights=self.average_weights, biases=self.average_biases, average_weights=(), average_biases=()
        )


def judging(environment, judges):
    """Which environments (indices in the run, (N,)) act as in the evaluation: 0, k, 2k, ... for k = judges > 0."""
    return environment % judges == 0 if judges else np.zeros(len(environment), dtype=bool)


@dataclass(frozen=True)
class WorkerState:
    """Everything that a worker's environments are, between two chunks. Arrays have N rows.

    environment: (N,) int64, index of each environment in the whole run.
    physics: (N, nstate) float64, MuJoCo's integration state (positions, velocities, warm start, ...).
    steps: (N,) int64, policy steps taken in the running episode.
    trembles: (N,) int64, C_t of Eq. 12.
    episode: (N,) int64, episodes begun so far; the counter of the planner's random numbers.
    task: (N, 4) float64, source state, moment (s), target state, rotation (rad).
    retained: (N,) bool, the task was kept after a failure instead of drawn.
    target_qpos, target_qvel: (N, 47), (N, 37), the target pose in the world.
    totals: (N, NUM_PARTS) float64, reward of the running episode by part (`REWARD_PARTS`).
    clock: policy steps taken since the start of the run; the counter of the actions' noise.
    """

    environment: np.ndarray
    physics: np.ndarray
    steps: np.ndarray
    trembles: np.ndarray
    episode: np.ndarray
    task: np.ndarray
    retained: np.ndarray
    target_qpos: np.ndarray
    target_qvel: np.ndarray
    totals: np.ndarray
    clock: int


# Parts of the reward, in the order of WorkerState.totals, Outcomes.parts
REWARD_PARTS = ("root_position", "root_velocity", "root_rotation", "key_bodies", "upper_body", "end", "tremble")
NUM_PARTS = len(REWARD_PARTS)

# How an episode ends; CONTINUES is none of them
CONTINUES, REACHED, FELL, TIMED_OUT = 0, 1, 2, 3

# Deviations of section 3, in the order of Outcomes.deviations
DEVIATIONS = (
    "root_position", "root_velocity", "root_rotation", "key_bodies", "joint_rotation", "lower_body", "joint_velocity",
)  # fmt: skip


@dataclass(frozen=True)
class Outcomes:
    """The E episodes that ended in a chunk, ordered by step, then by environment.

    clock: (E,) int64, policy steps since the start of the run. environment: (E,) int64, index in the run.
    task: (E, 4), retained: (E,), as in WorkerState.
    end: (E,) int8, REACHED, FELL or TIMED_OUT. fell_on: (E,) int16, the body that touched the ground, else -1.
    tightenings: (E,) int64, of the thresholds that judged the episode's last step.
    steps: (E,) int64, TS. trembles: (E,) int64, TC.
    parts: (E, NUM_PARTS) float64, accumulated reward by part; their sum is the return.
    deviations: (E, 7) float64 of the last frame, in `DEVIATIONS` order.
    """

    clock: np.ndarray
    environment: np.ndarray
    task: np.ndarray
    retained: np.ndarray
    end: np.ndarray
    fell_on: np.ndarray
    tightenings: np.ndarray
    steps: np.ndarray
    trembles: np.ndarray
    parts: np.ndarray
    deviations: np.ndarray

    def __len__(self):
        return len(self.end)

    def order(self):
        """Indices that put episodes in the order of this class, whoever collected them."""
        return np.lexsort((self.environment, self.clock))

    def take(self, order):
        """The episodes at the indices `order`."""
        return Outcomes(**{name: array[order] for name, array in vars(self).items()})


def concatenate_outcomes(items):
    """One `Outcomes` of a sequence of them, in order; at least one, which may be empty."""
    joined = Outcomes(**{name: np.concatenate([getattr(item, name) for item in items]) for name in vars(items[0])})
    return joined.take(joined.order())


@dataclass(frozen=True)
class Windows:
    """M windows of K steps of episodes, with the derivatives of physics along them (`workers.derivatives`). Ordered by
    environment; float32 unless said otherwise.

    A state x has 74 tangent coordinates; x_0 is the state before the first step, x_{k+1} that after step k.
    environment: (M,) int64, index in the run. limits: (M, 3), what d^rp, d^kp, d^q are measured by.
    begin: (M,) int64, the first step that is one of the episode's, which began with it if that is not 0: until then the
    window stands still in x_0, observation and mean repeated, derivatives zero.
    observation: (M, K + 1, 282), of x_0 to x_K. mean: (M, K, 31), the policy's output, without noise.
    by_action: (M, K, 74, 31), x_{k+1} by the action of step k.
    by_state: (M, K - 1, 74, 74), x_{k+1} by x_k, of the steps from the second on.
    seen: (M, K, 282, 74), the observation of x_{k+1} by x_{k+1}.
    """

    environment: np.ndarray
    limits: np.ndarray
    begin: np.ndarray
    observation: np.ndarray
    mean: np.ndarray
    by_action: np.ndarray
    by_state: np.ndarray
    seen: np.ndarray

    def __len__(self):
        return len(self.environment)

    def take(self, order):
        """The windows at the indices `order`."""
        return Windows(**{name: array[order] for name, array in vars(self).items()})


def concatenate_windows(items):
    """One `Windows` of a sequence of them, in order."""
    joined = Windows(**{name: np.concatenate([getattr(item, name) for item in items]) for name in vars(items[0])})
    return joined.take(np.argsort(joined.environment, kind="stable"))


@dataclass(frozen=True)
class Trials:
    """M episodes of H steps that go on when they have arrived: what windows are of. Ordered by environment.

    environment: (M,) int64, index in the run. limits: (M, 3) float32, what d^rp, d^kp, d^q are measured by.
    observation: (H + 1, M, 282) float32, before each step and after the last.
    standing: (H, M) bool, whether the figure has not fallen by the end of each step.
    """

    environment: np.ndarray
    limits: np.ndarray
    observation: np.ndarray
    standing: np.ndarray

    def __len__(self):
        return len(self.environment)


def concatenate_trials(items):
    """One `Trials` of a sequence of them, in order."""
    environment = np.concatenate([item.environment for item in items])
    order = np.argsort(environment, kind="stable")
    return Trials(
        environment=environment[order],
        limits=np.concatenate([item.limits for item in items])[order],
        observation=np.concatenate([item.observation for item in items], axis=1)[:, order],
        standing=np.concatenate([item.standing for item in items], axis=1)[:, order],
    )


@dataclass(frozen=True)
class Chunk:
    """T steps of N environments: what PPO and SBC learn from. float32 unless said otherwise.

    environment: (N,) int64, index of each environment in the whole run.
    observation: (T, N, 282), s_t. action: (T, N, 31), the policy's output with noise. mean: (T, N, 31), without.
    reward: (T, N), r_t of Eq. 13.
    end: (T, N) int8, CONTINUES, REACHED, FELL or TIMED_OUT after this step.
    last_observation: (N, 282), s_T of the running episodes (after a reset where one ended at the last step).
    final_observation: (E, 282), the observation that each ended episode ended in, in the order of `outcomes`.
    pose: (T, N, 84), qpos and qvel before the step. next_pose: (T, N, 84), after it, before any reset.
    pd_target: (T, N, 31), joint coordinates that the step's PD controllers aimed at.
    outcomes: the episodes that ended.
    version: version of the policy that acted.
    log_sigma: (T, N) float64, log standard deviation of its actions; not that of judges.
    windows, trials: with `arrival.weight`, after `arrival.after` updates; else None.
    """

    environment: np.ndarray
    observation: np.ndarray
    action: np.ndarray
    mean: np.ndarray
    reward: np.ndarray
    end: np.ndarray
    last_observation: np.ndarray
    final_observation: np.ndarray
    pose: np.ndarray
    next_pose: np.ndarray
    pd_target: np.ndarray
    outcomes: Outcomes
    version: int
    log_sigma: np.ndarray
    windows: Windows | None = None
    trials: Trials | None = None
