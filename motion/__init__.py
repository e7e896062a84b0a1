"""Clips, skeleton, rotations, file formats and state machines: all that needs no physics.

Imports numpy and PyYAML only (never torch, ray or mujoco), so that tools for animators start at once.
"""
