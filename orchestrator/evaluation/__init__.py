"""Evaluation of a policy on the grid of tasks: episodes, shards of them, statistics, the noise it bears, replays."""
