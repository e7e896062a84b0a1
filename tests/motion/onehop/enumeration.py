"""Slow, obvious search from the paper and shared/spec/onehop.md: explicit alignment, plain enumeration."""

import itertools
import math

import numpy as np

QUANTUM = 2.0**-33  # the grid of costs that the search documents


def distance(a, b, weights):
    """Kovar et al. 2002, their closed form in sums: align b to a, then the weighted mean of squared distances."""
    w = weights / weights.sum()
    xa, ya, xb, yb = a[..., 0], a[..., 1], b[..., 0], b[..., 1]
    sxa, sya, sxb, syb = (w * xa).sum(), (w * ya).sum(), (w * xb).sum(), (w * yb).sum()
    theta = math.atan2(
        (w * (ya * xb - xa * yb)).sum() - (sya * sxb - sxa * syb),
        (w * (xa * xb + ya * yb)).sum() - (sxa * sxb + sya * syb),
    )
    c, s = math.cos(theta), math.sin(theta)
    x0, y0 = sxa - (c * sxb - s * syb), sya - (s * sxb + c * syb)
    moved = np.stack([c * xb - s * yb + x0, s * xb + c * yb + y0, b[..., 2]], axis=-1)
    return (w * ((a - moved) ** 2).sum(axis=-1)).sum()


class Enumeration:
    """All candidates of a trigger, one by one. clips: ClipSet (its `window_points` is tested separately)."""

    def __init__(self, clips, config):
        self.clips, self.config, self.known = clips, config, {}
        self.weight = round(config.weight / QUANTUM) * QUANTUM
        self.shortest = min(config.lengths)

    def valid(self, clip, frame, length):
        """The frame modulo the loop if a window fits there, else None."""
        c = self.clips.clips[clip]
        if c.looping:
            return frame % (c.frames - 1)
        return frame if 0 <= frame and frame + length <= c.frames else None

    def d(self, clip_a, a, clip_b, b, length):
        """D times the length's scale on the grid, or None where a window does not fit."""
        a, b = self.valid(clip_a, a, length), self.valid(clip_b, b, length)
        if a is None or b is None:
            return None
        key = (length, *sorted([(clip_a, a), (clip_b, b)]))
        if key not in self.known:
            (i, p), (j, q) = key[1:]
            weights = np.outer(self.config.frame_weights_of(length), self.config.points)
            value = distance(
                self.clips.window_points(i, p, length), self.clips.window_points(j, q, length), weights
            )
            self.known[key] = round(value * self.config.blend_scale(length) / QUANTUM) * QUANTUM
        return self.known[key]

    def genre(self, hop, destination):
        if not self.config.genre_cost or self.clips.genres[hop] == self.clips.genres[destination]:
            return 0.0
        return round(self.config.genre_cost / QUANTUM) * QUANTUM

    def next_beat(self, clip, frame):
        """Frames to the next beat, walking on; None if there is none."""
        c, beats = self.clips.clips[clip], self.clips.beats[clip]
        for step in range(2 * c.frames):
            at = frame + step
            if c.looping:
                if any((at - beat) % (c.frames - 1) == 0 for beat in beats):
                    return step
            elif at in beats:
                return step
        return None

    def beats_agree(self, clip_a, a, clip_b, b):
        if not self.config.beats:
            return True
        a, b = self.next_beat(clip_a, a), self.next_beat(clip_b, b)
        return a is not None and a == b

    def starts(self, clip):
        c = self.clips.clips[clip]
        return range(c.frames - 1 if c.looping else c.frames)

    def offset(self, t, offset):
        return t if self.config.regime == "start" else offset

    def direct(self, source, destination, t, offset=0):
        value = Enumeration.d(_plain(self), source, t, destination, t - self.offset(t, offset), self.config.blend)
        return math.inf if value is None else value

    def one_hop(self, source, destination, t, offset=0):
        """Least (cost, R, hop, u, s_s, first length, second length, s_h), or None."""
        config, o = self.config, self.offset(t, offset)
        stays = range(config.max_stay + 1)
        best = None
        for stay, (i, b1), b2 in itertools.product(
            stays, itertools.product(range(len(self.clips)), config.lengths), config.lengths
        ):
            if self.valid(source, t + stay, b1) is None:
                continue
            for u in self.starts(i):
                first = self.d(source, t + stay, i, u, b1)
                if first is None or not self.beats_agree(source, t + stay, i, u):
                    continue
                for stay_hop in stays:
                    time = stay + b1 + stay_hop
                    second = self.d(i, u + b1 + stay_hop, destination, t + time - o, b2)
                    if second is None:
                        continue
                    r = stay + stay_hop + (b1 - self.shortest) + (b2 - self.shortest)
                    cost = first + second + self.weight * r + self.genre(i, destination)
                    key = (cost, r, i, u, stay, b1, b2, stay_hop)
                    best = key if best is None or key < best else best
        return best

    def two_hop(self, source, destination, t, offset=0):
        """Least (cost, R, hop, u, s_s, second hop, v, s_h, s_2) of two hops, or None."""
        config, o, b = self.config, self.offset(t, offset), self.config.lengths[0]
        stays = range(config.max_stay + 1)
        windows = [(i, u) for i in range(len(self.clips)) for u in self.starts(i) if self.valid(i, u, b) is not None]
        best = None
        for stay in stays:
            if self.valid(source, t + stay, b) is None:
                continue
            for i, u in windows:
                if not self.beats_agree(source, t + stay, i, u):
                    continue
                first = self.d(source, t + stay, i, u, b)
                if best is not None and first > best[0]:
                    continue
                for stay_hop in stays:
                    x = self.valid(i, u + b + stay_hop, b)
                    if x is None:
                        continue
                    for j, v in windows:
                        if not self.beats_agree(i, x, j, v):
                            continue
                        second = self.d(i, x, j, v, b)
                        if best is not None and first + second > best[0]:
                            continue
                        for stay_second in stays:
                            time = stay + 2 * b + stay_hop + stay_second
                            third = self.d(j, v + b + stay_second, destination, t + time - o, b)
                            if third is None:
                                continue
                            r = stay + stay_hop + stay_second
                            cost = first + second + third + self.weight * r
                            cost += self.genre(i, destination) + self.genre(j, destination)
                            key = (cost, r, i, u, stay, j, v, stay_hop, stay_second)
                            best = key if best is None or key < best else best
        return best


def _plain(enumeration):
    """The same without the scale of blend lengths: the direct transition has the length `blend`."""
    other = Enumeration.__new__(Enumeration)
    other.__dict__.update(enumeration.__dict__)
    other.known = {}
    return other
