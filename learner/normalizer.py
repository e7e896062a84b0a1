"""Running mean and variance of a stream of vectors, in float64."""

import torch

LEAST = 1e-8  # added to every variance


class Normalizer:
    """Scales vectors of `size` numbers to mean 0 and deviation 1 of all that `update` has seen.

    Before the first update, and when not `enabled`, it leaves vectors as they are.
    """

    def __init__(self, size, enabled, device):
        self.enabled = enabled
        self.count = 0.0
        self.mean = torch.zeros(size, dtype=torch.float64, device=device)
        self.squares = torch.zeros(size, dtype=torch.float64, device=device)

    def update(self, batch):
        """Take in a batch (n, size): Chan's parallel update of mean and sum of squared differences."""
        if not self.enabled:
            return
        batch = batch.to(torch.float64)
        n, mean = len(batch), batch.mean(dim=0)
        difference = mean - self.mean
        total = self.count + n
        self.squares += ((batch - mean) ** 2).sum(dim=0) + difference**2 * (self.count * n / total)
        self.mean += difference * (n / total)
        self.count = total

    def mean_and_scale(self):
        """(mean, 1 / deviation), each (size,) float64."""
        if self.count < 2:
            return self.mean, torch.ones_like(self.mean)
        return self.mean, 1.0 / torch.sqrt(self.squares / self.count + LEAST)

    def __call__(self, batch):
        """The scaled batch (n, size) as float32, clipped to +-10 as in `workers.inference`."""
        mean, scale = self.mean_and_scale()
        return ((batch - mean.float()) * scale.float()).clamp(-10.0, 10.0)

    def become(self, mean, scale, count):
        """One that has seen `count` vectors and has this mean and 1 / deviation (size,)."""
        self.count = float(count)
        self.mean.copy_(torch.as_tensor(mean))
        self.squares.copy_(count * (torch.as_tensor(scale).double() ** -2 - LEAST).clamp(min=0.0))

    def state_dict(self):
        """Plain tensors and numbers for a checkpoint."""
        return {"count": self.count, "mean": self.mean.clone(), "squares": self.squares.clone()}

    def load_state_dict(self, state):
        """The inverse of `state_dict`."""
        self.count = state["count"]
        self.mean.copy_(state["mean"])
        self.squares.copy_(state["squares"])
