"""Poses and deviations in what is observed, as tensors: the environment's own."""

import numpy as np
import pytest
import torch

from learner.encoding import deviations, split
from workers.reward import KP, RP, Q


@pytest.mark.parametrize("encoding", ("absolute", "difference"))
def test_both_encodings_hold_the_same_poses(encoding, lessons):
    """`difference` is p_tar less p_t, but for the root's place, which is relative already, and its height."""
    seen = torch.as_tensor(np.ascontiguousarray(lessons[0].observation).reshape(-1, 282))  # of the paper's encoding
    encoded = seen.clone()
    for k in range(139 if encoding == "difference" else 0):
        encoded[:, 143 + k] -= seen[:, 1 + k]
    pose, target = split(encoded, encoding == "difference")
    torch.testing.assert_close(torch.cat([pose, target], dim=1), seen, atol=1e-5, rtol=1e-5)


def test_deviations_are_the_environments(lessons):
    chunk = lessons[0]
    ended = torch.as_tensor(chunk.final_observation)
    assert len(ended) > 5
    found = deviations(*split(ended, False))
    np.testing.assert_allclose(found, chunk.outcomes.deviations[:, [RP, KP, Q]], atol=1e-4, rtol=1e-3)
