"""What shapes the environment. Plain dataclasses: `orchestrator.config` composes them and checks their values.

References (Eq., section) are to the equations as this project reads them, docs/equations.md. A default is the paper's,
or the project's reading of it; what departs from the paper is switched on in a file of configs/scale/, by name.
"""

from dataclasses import dataclass, field


@dataclass
class RewardConfig:
    """The reward of Eq. 1-13. The two switches are rows of the paper's table."""

    upper_body_penalty: bool = True
    """Double negative improvements of the upper body (S of Eq. 8). False: the row No URP."""
    tremble: bool = True
    """Penalise joint velocities that change sign (Eq. 12). False: the row No TR."""
    tremble_ramp: int = 0
    """The tremble term grows to its full weight over this many tightenings of the curriculum. 0, the paper: full from
    the start, which at loose thresholds makes an early fall cheaper than a long way to the target."""
    key_body_frame: str = "common"
    """Where key bodies are compared: `common` (both poses in the frame of p_t) or `own` (each in its own)."""
    failure: float = -3.0
    """r_end of a fall or a time-out (Eq. 9)."""


@dataclass
class ReachConfig:
    """When the target counts as reached (section 4)."""

    heading: bool = False
    """Ask also for d^rq, the root's orientation, below a threshold of its own. Off in the paper."""
    heading_start: float = 1.0
    """First threshold of d^rq in rad, if `heading`."""
    heading_floor: float = 0.1
    """Last threshold of d^rq in rad, if `heading`."""


@dataclass
class FallConfig:
    """What counts as a fall (section 3)."""

    ignore_bodies: list[str] = field(default_factory=lambda: ["sword", "shield"])
    """Bodies that may touch the ground besides the feet."""


@dataclass
class RotationConfig:
    """How the target is turned about the vertical (section 4). The range is `motions.rotation`."""

    reference: str = "source"
    """Angle 0 keeps the character's heading (`source`) or the target clip's own heading (`world`)."""


@dataclass
class TaskConfig:
    """The task planner (section 4)."""

    stay_probability: float = 0.5
    """Probability of keeping the same task after a failure."""
    focus: float = 0.0
    """Share of the new tasks that are drawn by how often such tasks fail (`orchestrator.focus`); the others, and all
    tasks of judging environments, are uniform. 0, the paper: all uniform. Needs `policy.judges`."""
    transition_time: float = 0.8
    """T of Eq. 14 in seconds."""
    max_steps: int = 60
    """A transition that takes more policy steps than this is a failure (time-out)."""
    training_steps: int | None = None
    """The same in training, where it is earlier: who has missed a tight target seldom comes back, and to watch how it
    falls costs samples. None, the paper: `max_steps`."""

    @property
    def time_limit(self):
        """Policy steps that an episode may take, in training."""
        return self.max_steps if self.training_steps is None else min(self.training_steps, self.max_steps)


@dataclass
class ObservationConfig:
    """How the state reaches the networks (section 2)."""

    target: str = "absolute"
    """`absolute`: p_tar as it is (the paper's). `difference`: p_tar less p_t, all but its root's place, which is
    relative already: the same state, in numbers that go to zero as the figure arrives."""


@dataclass
class ActionConfig:
    """What the 31 numbers of an action mean (section 2)."""

    mode: str = "absolute"
    """`absolute`: the PD target itself (the paper's). `target`: an offset from the target pose's joint rotations.
    `current`: an offset from the current pose's."""
    scale: float = 1.0
    """Radians per unit of the policy's output."""


@dataclass
class PhysicsConfig:
    """Simulation (section 1 and 7): 120 Hz physics, 30 Hz policy."""

    timestep: float = 1.0 / 120.0
    """Seconds per physics step."""
    substeps: int = 4
    """Physics steps per action."""
    iterations: int = 10
    """Most iterations of the Newton solver."""
    ls_iterations: int = 10
    """Most iterations of its line search."""
    tolerance: float = 1e-6
    """The solver stops when an iteration improves its (scaled) cost by less; MuJoCo's 1e-8 moves nothing visible."""
    sole: float = 0.0
    """Depth in m over which the soles of the feet give way, half of it below the foot's box: the ground's force begins
    at zero there. 0: the foot's box itself, whose corners take hold at once (MuJoCo's default contact), so that the
    smallest push may decide which of them holds."""
    max_speed: float = 200.0
    """A simulation in which anything moves faster (m/s, rad/s) has exploded; its episode ends as a failure. Falls and
    wild actions stay below 50."""
    max_unstable_share: float = 0.01
    """Stop the run when more than this share of the simulations explodes in one iteration (rounded up)."""


@dataclass
class ArrivalConfig:
    """Descent of what is left to the target, through derivatives of physics along a few steps of episodes played for it
    (`learner/arrival.py`; not in the paper). A step's take as long as ten simulated ones."""

    weight: float = 0.0
    """Of its gradient, clipped as PPO's is, in the mean with that. 0, the paper: none."""
    after: int = 0
    """Updates before the first episodes are played for it: PPO, whose chunks are far cheaper, goes ahead."""
    share: float = 0.3
    """Share of the environments beside which an episode is played for it in every chunk."""
    windows: int = 1
    """Windows of each such episode; where each ends is drawn on its own."""
    lead: int = 5
    """What is left is measured by the thresholds of so many tightenings on, which is where the root's place
    counts as much as the joints."""
    noise: float = 0.5
    """Deviation of the noise under which the policy is followed through what the derivatives say, in units
    of the evaluation's. Physics is linear at 0.3 (correlation 0.84 over eight steps), much less so at 1 (0.53)."""
    draws: int = 4
    """Draws of that noise for each episode and step of the policy."""
    steps: int = 5
    """K, how many steps are followed again, up to any of an episode; all steps of what is shorter."""
    discount: float = 0.93
    """Of what is left after each further step; after the last of a window a network foresees the rest."""
    ends: float | None = None
    """What is left after a step (the sum of squares of `learner.encoding.residuals`) that ends half of what is to come:
    who arrives need not stay, and not in every pose can one. At the thresholds in all three it is 3. Windows end at a
    first arrival at the latest then. None: nothing ends, who arrives has to stay."""
    time: float = 0.0
    """Cost of every step besides what is left: being off by three times the thresholds costs 2.5."""
    batch_size: int = 64
    """Windows per step of the policy."""
    target_kl: float | None = None
    """The KL divergence that an update beside windows aims at instead of `ppo.target_kl`, under the evaluation's noise,
    whatever exploration's is. None: as PPO's."""
    final_kl: float | None = None
    """`target_kl` goes to this as `ppo.target_kl` to `ppo.final_kl`. None: it stays."""
    hidden: list[int] = field(default_factory=lambda: [512, 512])
    """Units of the hidden layers of the network (SiLU) that foresees what is left later."""


@dataclass
class EnvConfig:
    """Everything that shapes the environment, and what is measured in it, besides the clips."""

    reward: RewardConfig = field(default_factory=RewardConfig)
    reach: ReachConfig = field(default_factory=ReachConfig)
    fall: FallConfig = field(default_factory=FallConfig)
    rotation: RotationConfig = field(default_factory=RotationConfig)
    task: TaskConfig = field(default_factory=TaskConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    action: ActionConfig = field(default_factory=ActionConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    arrival: ArrivalConfig = field(default_factory=ArrivalConfig)
