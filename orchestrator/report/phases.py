"""The phases of a take and their colours: the source's clip, the transition, the target's clip."""

SOURCE, TRANSITION, TARGET = 0, 1, 2
BLUE, ORANGE = (0.27, 0.53, 0.86), (0.95, 0.50, 0.13)
COLOURS = (BLUE, ORANGE, BLUE)  # of the phases, as in the paper's Fig. 1
