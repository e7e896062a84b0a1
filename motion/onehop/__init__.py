"""One-hop transitions (Koyama and Goto 2019): exact search, lookup table, runtime player and report.

Kinematic only: imports numpy and numba, never torch, ray or mujoco. Start with `clips.ClipSet`, `search.build` and
`table.LookupTable`.
"""
