"""What shapes the learner. Plain dataclasses: `orchestrator.config` composes them and checks their values."""

from dataclasses import dataclass, field


@dataclass
class NetworkConfig:
    """Two separate MLPs, policy and value (section 5)."""

    hidden: list[int] = field(default_factory=lambda: [1024, 512])
    """Units of the hidden layers (ReLU)."""
    value_hidden: list[int] | None = None
    """Those of the value network, if other than the policy's."""
    output_scale: float = 0.01
    """Factor on the policy's initial output weights: small, so that training starts near action zero."""


@dataclass
class PolicyConfig:
    """The Gaussian policy (section 5)."""

    log_sigma: float = -2.9
    """Log of the fixed standard deviation of the network's actions in training; `action.scale` times it in radians."""
    noise_window: int = 1
    """Noise is the moving average of this many independent draws, scaled back to the same deviation. 1, the paper:
    independent at every step. More: a push lasts several steps, so that it shows in how the episode ends."""
    independent_from: int | None = None
    """Tightenings of a task's thresholds from which on its noise is independent at every step, whatever `noise_window`
    is: a push of several steps moves the figure farther than tight thresholds are wide. None: never."""
    judges: int = 0
    """k: the environments 0, k, 2k, ... act as in the evaluation, with independent noise of `judge_log_sigma`; PPO does
    not learn from them, and they alone move the curriculum. 0, the paper: none; all explore and all are counted."""
    judge_log_sigma: float = -3.7
    """Log of the standard deviation of judging environments' actions, in radians (as `evaluation.log_sigma`)."""
    sigma_factor: float = 1.0
    """Every tightening of a task's thresholds multiplies the standard deviation of its actions by this, down to judges'
    own: what has to be met more exactly is explored more finely. 1, the paper: fixed."""
    average: float = 0.0
    """Decay per update of a running average of the policy's weights, which judging environments act with and which is
    evaluated: large steps wander around what their average already is. 0, the paper: none."""


@dataclass
class PPOConfig:
    """Proximal policy optimisation (section 5)."""

    gamma: float = 0.99
    """Discount per policy step."""
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation."""
    clip: float = 0.2
    """Clip range of the probability ratio."""
    epochs: int = 4
    """Times each transition is used per update."""
    minibatch_size: int = 512
    """Transitions per step, at most; a chunk is cut into equal minibatches no larger than this."""
    optimizer: str = "adam"
    """How the policy descends: `adam`, or `kfac`, the natural gradient by Kronecker factors (`learner/kfac.py`). The
    value network has Adam."""
    kfac_after: int = 0
    """kfac: so many updates with Adam come first."""
    policy_after: int = 0
    """So many updates at the beginning leave the policy as it is, while the value network (and the cost-to-go) learns:
    for a run that begins with a policy alone (`start.checkpoint`)."""
    damping: float = 0.03
    """kfac: added to the factors' diagonals, in units of the mean of their eigenvalues."""
    natural_rate: float = 0.1
    """kfac: step size when it begins."""
    natural_epochs: int | None = None
    """kfac: times each transition is used per update. None: `epochs`."""
    learning_rate: float = 3e-4
    """Adam's step size: of the value network, and at the start of the policy."""
    target_kl: float | None = None
    """Adapt the learning rate towards this KL divergence per update; none: keep it fixed."""
    final_kl: float | None = None
    """`target_kl` goes to this in a straight line over the first `kl_updates` updates: first far steps, then small ones
    that average the gradient's noise. None: it stays."""
    kl_updates: int = 0
    """Updates until `final_kl` is reached."""
    first_updates: int = 0
    """So many updates at the beginning go farther still: they aim at `first_kl` at first, and each at the same factor
    of the one before, down to the line above. Ahead at first, a little behind after 2e6 samples (lab book, section
    16). 0: none."""
    first_kl: float = 1.0
    """The KL divergence that the very first update aims at, if `first_updates` and `target_kl` are given."""
    first_clip: float = 1.0
    """Clip range of those updates: a long step leaves a narrow one with most of its samples."""
    max_grad_norm: float = 1.0
    """Gradients are clipped to this norm."""
    max_skipped: int = 5
    """Stop the run when this many updates in a row were skipped, their losses or gradients not being finite."""
    timeout: str = "terminal"
    """Value after a time-out: `terminal` (zero: it is a failure with a reward of its own, Eq. 9) or `bootstrap`
    (the value of the pose that it ended in)."""
    normalize_observations: bool = True
    """Scale observations by their running mean and deviation."""
    normalize_values: bool = True
    """Let the value network predict returns scaled by their running mean and deviation."""

    def method(self, updates):
        """`adam` or `kfac`: how the policy descends after so many updates."""
        return "kfac" if self.optimizer == "kfac" and updates >= self.kfac_after else "adam"

    def passes(self, method):
        """How often an update with a `method` uses each transition."""
        return self.natural_epochs if method == "kfac" and self.natural_epochs is not None else self.epochs

    def clip_range(self, updates):
        """The clip range after so many updates."""
        return self.first_clip if updates < self.first_updates else self.clip


@dataclass
class SBCConfig:
    """Self-Behavior Cloning (Algorithm 1, Eq. 17)."""

    enabled: bool = True
    """False: the row No SBC."""
    weight: float = 0.533
    """w_sbc of Eq. 17."""
    gap_weighting: str = "balanced"
    """g of Eq. 17: `balanced` (T-1)/(T-gap), `inverse` (T-1)/gap, or `uniform` 1."""
    batch_size: int = 0
    """K, demonstrations per step; 0: as many as a PPO minibatch."""
    reduction: str = "sum"
    """`sum` over the K demonstrations (Eq. 17) or their `mean`."""


@dataclass
class LearnerConfig:
    """Everything that shapes an update, besides `workers.config.ArrivalConfig`."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    sbc: SBCConfig = field(default_factory=SBCConfig)
