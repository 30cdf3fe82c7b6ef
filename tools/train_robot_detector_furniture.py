"""Furniture, and what lies about on floors and tables: much of it round, flat or dark, as a robot is."""

from __future__ import annotations

import numpy as np
import train_robot_detector_textures as tex
from train_robot_detector_scene import CLEAR_M, Scene


def add_furniture(s: Scene, room: np.ndarray) -> None:
    """One large piece somewhere: cupboard, sofa, table, chair, bed, counter, door leaf, curtain."""
    rng = s.rng
    x, y = rng.uniform(room[0], room[1]), rng.uniform(room[2], room[3])
    if rng.random() < 0.5:
        x, y = np.clip(rng.normal(0, 1.2, 2), [room[0], room[2]], [room[1], room[3]])
    yaw = rng.choice([0.0, np.pi / 2]) if rng.random() < 0.7 else rng.uniform(0, np.pi)
    m, n = s.covered(), s.plain()
    c, d = np.cos(yaw), np.sin(yaw)

    def at(u: float, v: float) -> tuple[float, float]:
        return x + u * c - v * d, y + u * d + v * c

    pick = rng.random()
    if pick < 0.22:  # cupboard, fridge, counter
        a, b, h = rng.uniform(0.2, 1.2), rng.uniform(0.15, 0.4), rng.uniform(0.3, 2.2)
        if not s.free(x, y, np.hypot(a, b)):
            return
        plinth = rng.uniform(0.0, 0.15)
        s.box(x, y, plinth, yaw, a, b, h, m)
        if plinth > 0.03:
            s.box(x, y, 0.0, yaw, a - 0.03, b - 0.04, plinth, n)
        for k in range(int(rng.integers(0, 5))):
            s.box(*at(0.0, -b), plinth + h * (k + 0.5) / 5, yaw, rng.uniform(0.03, a), 0.012, 0.02, n)
    elif pick < 0.45:  # sofa, armchair, bed
        a, b, h = rng.uniform(0.35, 1.1), rng.uniform(0.35, 0.8), rng.uniform(0.25, 0.5)
        if not s.free(x, y, np.hypot(a, b)):
            return
        lift = rng.uniform(0.0, 0.16)
        s.box(x, y, lift, yaw, a, b, h - lift, m)
        s.box(*at(0.0, b), lift, yaw, a, 0.1, rng.uniform(0.5, 0.95), m)
        if rng.random() < 0.6:
            for e in (-1, 1):
                s.box(*at(e * a, 0.0), lift, yaw, 0.09, b, rng.uniform(0.45, 0.65), m)
        for _ in range(int(rng.integers(0, 4))):
            px, py = at(rng.uniform(-0.8, 0.8) * a, rng.uniform(-0.3, 0.8) * b)
            s.ball(px, py, h + 0.1, rng.uniform(0, 3), 0.22, 0.1, 0.18, s.plain())
        for e in (-1, 1):
            for f in (-1, 1):
                s.round(*at(e * (a - 0.06), f * (b - 0.06)), 0.0, 0.02, 0.03, lift + 0.01, n)
    elif pick < 0.8:  # table or chair: legs, nothing below
        small = rng.random() < 0.5
        a = rng.uniform(0.18, 0.25) if small else rng.uniform(0.3, 1.0)
        b = a if small else rng.uniform(0.25, 0.5)
        h = rng.uniform(0.4, 0.5) if small else rng.uniform(0.35, 0.78)
        leg = rng.uniform(0.01, 0.045)
        legs = [at(e * (a - leg), f * (b - leg)) for e in (-1, 1) for f in (-1, 1)]
        if not all(s.free(px, py, 0.05 - CLEAR_M) for px, py in legs) or not s.free(x, y, 0.0):
            return
        if rng.random() < 0.15:
            s.round(x, y, h, a, a, 0.03, m)
            s.round(x, y, 0.02, 0.03, 0.03, h, n)
            s.round(x, y, 0.0, rng.uniform(0.15, 0.3), 0.1, 0.03, n)
        else:
            s.box(x, y, h, yaw, a, b, rng.uniform(0.015, 0.06), m)
            for px, py in legs:
                if rng.random() < 0.5:
                    s.round(px, py, 0.0, 0.6 * leg, leg, h, n)
                else:
                    s.box(px, py, 0.0, yaw, leg, leg, h, n)
        if small:
            s.box(*at(0.0, b), h, yaw, a, 0.015, rng.uniform(0.3, 0.5), m)
        elif rng.random() < 0.7:
            for _ in range(int(rng.integers(1, 5))):
                small_thing(s, *at(rng.uniform(-0.7, 0.7) * a, rng.uniform(-0.7, 0.7) * b), h + 0.04)
    elif pick < 0.9:  # curtain, door leaf, radiator
        a = rng.uniform(0.2, 0.9)
        if s.free(x, y, a):
            s.box(x, y, rng.uniform(0.0, 0.05), yaw, a, rng.uniform(0.01, 0.06), rng.uniform(0.6, 2.3), m)
    elif s.free(x, y, 0.3):  # a person's or an animal's legs, a plant, a bin
        for e in (-1, 1):
            s.round(*at(e * 0.1, 0.0), 0.05, 0.05, 0.09, 0.85, m)
            s.ball(*at(e * 0.1, -0.06), 0.04, yaw, 0.05, 0.13, 0.045, n)
        s.ball(x, y, 1.15, yaw, 0.22, 0.14, 0.4, s.covered())


def add_clutter(s: Scene, room: np.ndarray, near: tuple[float, float], spread: float) -> None:
    """Something small that lies about; much of it is round or dark, as a robot is."""
    rng = s.rng
    x, y = near[0] + rng.normal(0, spread), near[1] + rng.normal(0, spread)
    if not (room[0] < x < room[1] and room[2] < y < room[3]) or not s.free(x, y, 0.2 - CLEAR_M):
        return
    if rng.random() < 0.1:  # cable
        angle, m = rng.uniform(0, 2 * np.pi), s.plain()
        for _ in range(int(rng.integers(4, 12))):
            x1, y1 = x + 0.12 * np.cos(angle), y + 0.12 * np.sin(angle)
            s.overlays.append(
                [0, (x + x1) / 2, (y + y1) / 2, np.cos(angle), np.sin(angle), 0.065, 0.006, 0, m]
            )
            x, y, angle = x1, y1, angle + rng.normal(0, 0.6)
        return
    small_thing(s, x, y, 0.0)


def small_thing(s: Scene, x: float, y: float, z: float) -> None:
    """A thing on the floor, or at the height `z` on a piece of furniture."""
    rng = s.rng
    m, n, yaw = s.plain(), s.plain(), rng.uniform(0, 2 * np.pi)
    pick = rng.random()
    if pick < 0.17:  # bowl, plate, pan
        r, h = rng.uniform(0.05, 0.17), rng.uniform(0.015, 0.09)
        s.round(x, y, z, rng.uniform(0.5, 0.95) * r, r, h, m, n)
        if rng.random() < 0.4:
            for _ in range(4):
                s.ball(
                    x + rng.normal(0, 0.03), y + rng.normal(0, 0.03), z + h, yaw, 0.04, 0.03, 0.03, s.plain()
                )
    elif pick < 0.27:  # shoes
        for e in (-1, 1):
            px, py = x - e * 0.07 * np.sin(yaw), y + e * 0.07 * np.cos(yaw)
            s.ball(px, py, z + 0.03, yaw + rng.normal(0, 0.2), 0.14, 0.05, 0.045, m)
            s.ball(px - 0.06 * np.cos(yaw), py - 0.06 * np.sin(yaw), z + 0.06, yaw, 0.06, 0.045, 0.06, m)
            s.box(px, py, z, yaw, 0.12, 0.04, 0.015, n)
    elif pick < 0.39:  # ball
        r = rng.uniform(0.03, 0.16)
        s.ball(x, y, z + r, yaw, r, r, r, m)
    elif pick < 0.48:  # lamp: a flat foot and a pole
        r = rng.uniform(0.08, 0.17)
        s.round(x, y, z, r, rng.uniform(0.6, 1.0) * r, rng.uniform(0.01, 0.035), m)
        s.round(x, y, z + 0.01, 0.012, 0.012, rng.uniform(0.3, 1.8), n)
    elif pick < 0.62:  # pot, bin, bucket, stool, pouf
        r, h = rng.uniform(0.08, 0.25), rng.uniform(0.16, 0.5)
        s.round(x, y, z, rng.uniform(0.7, 1.05) * r, r, h, m, n)
        if rng.random() < 0.4:
            leaf = s.material(np.array([0.05, 0.2, 0.04]) * rng.uniform(0.5, 2))
            for _ in range(6):
                s.ball(
                    x + rng.normal(0, 0.1),
                    y + rng.normal(0, 0.1),
                    z + h + abs(rng.normal(0.2, 0.15)),
                    yaw,
                    0.08,
                    0.03,
                    0.12,
                    leaf,
                )
    elif pick < 0.76:  # book, box, scale, bag
        a, b, h = rng.uniform(0.04, 0.22), rng.uniform(0.04, 0.2), rng.uniform(0.01, 0.3)
        s.box(x, y, z, yaw, a, b, h, m, n if rng.random() < 0.4 else -1)
    elif pick < 0.9:  # toys, towel: a heap
        for _ in range(int(rng.integers(2, 6))):
            a, b, h = rng.uniform(0.015, 0.12, 3)
            s.ball(
                x + rng.normal(0, 0.08),
                y + rng.normal(0, 0.08),
                z + 0.6 * h,
                rng.uniform(0, 3),
                a,
                b,
                h,
                s.plain(),
            )
    else:  # cushion
        s.ball(x, y, z + 0.07, yaw, *rng.uniform(0.15, 0.3, 2), rng.uniform(0.05, 0.1), s.covered())


def add_rugs(s: Scene) -> None:
    """Rugs, mats, painted circles; flat on the floor."""
    rng = s.rng
    for _ in range(int(rng.choice([0, 1, 1, 2, 3]))):
        pick = rng.random()
        m = (
            s.covered()
            if pick < 0.4
            else s.material(np.ones(3), s.texture(tex.carpet(rng)), rng.uniform(0.4, 1.6))
        )
        yaw = rng.choice([0.0, 0.3, 0.8, 1.57])
        if pick < 0.7:
            a, b = rng.uniform(0.3, 1.6, 2)
            shape = 0
        else:  # small round ones look most like a robot
            a = rng.uniform(0.12, 1.2)
            b, shape = a * rng.choice([1.0, 1.0, 0.6]), int(rng.integers(1, 3))
        x, y = rng.normal(0, 1.0, 2)
        s.overlays.append([shape, x, y, np.cos(yaw), np.sin(yaw), a, b, rng.uniform(0.02, 0.1), m])
