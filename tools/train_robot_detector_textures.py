"""Procedural surfaces for training pictures: wood, tiles, carpet, cloth, courts. Nothing is a photograph."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np

SIDE_PX = 512
Texture = np.ndarray
"""(SIDE_PX, SIDE_PX, 3) float32, linear colour 0..1, RGB."""


def noise(
    rng: np.random.Generator, octaves: tuple[int, ...], stretch: tuple[float, float] = (1.0, 1.0)
) -> Texture:
    """(SIDE_PX, SIDE_PX) of about unit variance; octaves: cells per side; stretch along x and y."""
    out = np.zeros((SIDE_PX, SIDE_PX), np.float32)
    for k, cells in enumerate(octaves):
        shape = (max(2, int(cells / stretch[1])), max(2, int(cells / stretch[0])))
        coarse = rng.standard_normal(shape).astype(np.float32)
        out += cv2.resize(coarse, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_CUBIC) / (1.0 + 0.5 * k)
    return out / max(float(out.std()), 1e-6)


def letters(image: Texture, text: str, at: list[int], size: float, paint: list[float], wide: int) -> None:
    """Lettering; OpenCV writes on bytes only."""
    mask = np.zeros(image.shape[:2], np.uint8)
    cv2.putText(mask, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, 255, wide, cv2.LINE_AA)
    share = (mask.astype(np.float32) / 255.0)[:, :, None]
    image[:] = image * (1.0 - share) + share * np.array(paint, np.float32)


def colour(rng: np.random.Generator, low: float = 0.05, high: float = 0.9, tint: float = 0.35) -> np.ndarray:
    """A colour of a home, linear RGB: mostly greyish or brownish, sometimes strong."""
    value = rng.uniform(low, high) ** 1.6
    if rng.random() < 0.12:
        return np.clip(value * 2.0 * rng.dirichlet(np.ones(3) * rng.uniform(0.7, 4.0)) * 1.5, 0.01, 0.95)
    warm = rng.uniform(-0.3, 1.0) * tint
    return np.clip(value * np.array([1.0 + warm, 1.0 + 0.15 * warm, 1.0 - warm]), 0.01, 0.95)


def wood_colour(rng: np.random.Generator) -> np.ndarray:
    """From beech to wenge, greyed oak and cherry among them."""
    hues = [
        (0.75, 0.50, 0.26),
        (0.55, 0.30, 0.13),
        (0.28, 0.12, 0.05),
        (0.36, 0.10, 0.04),
        (0.55, 0.47, 0.38),
        (0.85, 0.66, 0.42),
        (0.12, 0.06, 0.035),
        (0.62, 0.38, 0.17),
        (0.40, 0.33, 0.27),
    ]
    base = np.array(hues[rng.integers(len(hues))])
    return np.clip(base * rng.uniform(0.7, 1.25) * rng.uniform(0.9, 1.1, 3), 0.01, 0.95)


def planks(rng: np.random.Generator) -> Texture:
    """Boards with grain, joints and boards of different tone."""
    base = wood_colour(rng)
    out = np.ones((SIDE_PX, SIDE_PX), np.float32)
    tone = np.ones((SIDE_PX, SIDE_PX, 3), np.float32)
    rows = int(rng.integers(6, 30))
    edges = np.linspace(0, SIDE_PX, rows + 1).round().astype(int)
    spread, joint, warm = rng.uniform(0.02, 0.22), rng.uniform(0.3, 1.0), rng.uniform(0.0, 0.06)
    length = rng.uniform(0.25, 1.5) * SIDE_PX
    for y0, y1 in pairwise(edges.tolist()):
        x = -rng.uniform(0, length)
        while x < SIDE_PX:
            x1 = x + length * rng.uniform(0.7, 1.3)
            a, b = max(int(x), 0), max(int(x1), 0)
            tone[y0:y1, a:b] = rng.lognormal(0.0, spread) * (1.0 + warm * rng.standard_normal(3))
            if b < SIDE_PX:
                out[y0:y1, b : b + 1] *= joint
            x = x1
        out[y0 : y0 + 1] *= joint
    grain = noise(rng, (64, 128), (8.0, 0.5)) * rng.uniform(0.02, 0.16) + noise(
        rng, (8, 16), (6.0, 1.0)
    ) * rng.uniform(0, 0.1)
    image = base * tone * (out * np.exp(grain))[:, :, None]
    return np.clip(image, 0.005, 1.0).astype(np.float32)


def parquet(rng: np.random.Generator) -> Texture:
    """Squares of strips, turned in turns."""
    strips, cells = int(rng.integers(3, 8)), int(rng.integers(4, 12))
    step = SIDE_PX // cells
    base, image = wood_colour(rng), np.zeros((SIDE_PX, SIDE_PX, 3), np.float32)
    spread = rng.uniform(0.05, 0.25)
    for i in range(cells + 1):
        for j in range(cells + 1):
            tile = np.repeat(rng.lognormal(0.0, spread, strips), step // strips + 1)[:step]
            tile = np.tile(tile[:, None], (1, step))
            tile = tile.T if (i + j) % 2 else tile
            y, x = i * step, j * step
            part = image[y : y + step, x : x + step]
            part[:] = (base * tile[:, :, None])[: part.shape[0], : part.shape[1]]
    return np.clip(image * np.exp(0.05 * noise(rng, (64, 128)))[:, :, None], 0.005, 1.0).astype(np.float32)


def tiles(rng: np.random.Generator) -> Texture:
    """Square or oblong tiles with joints, marbled or plain, now and then a chequerboard."""
    nx, ny = int(rng.integers(2, 9)), int(rng.integers(2, 9))
    if rng.random() < 0.6:
        ny = nx
    base, other = colour(rng, 0.2, 0.95), colour(rng)
    chequer = rng.random() < 0.15
    tone = rng.lognormal(0.0, rng.uniform(0.0, 0.15), (ny, nx))
    cells = base * tone[:, :, None]
    if chequer:
        cells[(np.indices((ny, nx)).sum(0) % 2) == 1] = other
    image = cv2.resize(cells.astype(np.float32), (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_NEAREST)
    image *= np.exp(rng.uniform(0, 0.18) * noise(rng, (4, 8, 16, 32, 64)))[:, :, None]
    joint, wide = colour(rng, 0.1, 0.9), int(rng.integers(1, 5))
    for k in range(nx + 1):
        x = round(k * SIDE_PX / nx)
        image[:, max(0, x - wide) : x + 1] = joint
    for k in range(ny + 1):
        y = round(k * SIDE_PX / ny)
        image[max(0, y - wide) : y + 1] = joint
    return np.clip(image, 0.005, 1.0).astype(np.float32)


def carpet(rng: np.random.Generator) -> Texture:
    """Pile of one colour, or a pattern of stripes, squares, rings or flecks."""
    image = np.ones((SIDE_PX, SIDE_PX, 3), np.float32) * colour(rng, 0.15, 0.95)
    kind = rng.random()
    y, x = np.mgrid[0:SIDE_PX, 0:SIDE_PX] / SIDE_PX
    other = colour(rng)
    if kind < 0.15:
        mask = np.sin(2 * np.pi * rng.integers(2, 14) * (x if rng.random() < 0.5 else y)) > rng.uniform(
            -0.7, 0.7
        )
        image[mask] = other
    elif kind < 0.25:
        image[noise(rng, (int(rng.integers(4, 40)),)) > rng.uniform(0.0, 1.2)] = other
    elif kind < 0.33:
        n = rng.integers(1, 6)
        image[np.sin(2 * np.pi * n * np.hypot((x * 3) % 1 - 0.5, (y * 3) % 1 - 0.5) * 3) > 0] = other
    elif kind < 0.4:
        n = int(rng.integers(2, 10))
        image[(np.floor(x * n) + np.floor(y * n)) % 2 == 1] = other
    pile = noise(rng, (256, 512)) * rng.uniform(0.03, 0.3) + noise(rng, (16, 64)) * rng.uniform(0.0, 0.1)
    return np.clip(image * np.exp(pile)[:, :, None], 0.005, 1.0).astype(np.float32)


def stone(rng: np.random.Generator) -> Texture:
    """Concrete, linoleum, marble."""
    field = noise(rng, (3, 6, 12, 24, 64, 128)) * rng.uniform(0.01, 0.25)
    if rng.random() < 0.3:
        field -= rng.uniform(0.2, 0.8) * np.exp(-np.abs(noise(rng, (3, 6, 12))) * 15.0)
    return np.clip(colour(rng, 0.2, 0.95) * np.exp(field)[:, :, None], 0.005, 1.0).astype(np.float32)


def court(rng: np.random.Generator) -> Texture:
    """A floor with painted lines, fields, circles and letters, as in gyms."""
    image = planks(rng) if rng.random() < 0.7 else stone(rng)
    for _ in range(int(rng.integers(2, 12))):
        paint, wide = colour(rng, 0.02, 0.95).tolist(), int(rng.integers(2, 9))
        a, b = rng.integers(0, SIDE_PX, 2).tolist(), rng.integers(0, SIDE_PX, 2).tolist()
        kind = rng.random()
        if kind < 0.45:
            line = (a, [b[0], a[1]] if rng.random() < 0.5 else [a[0], b[1]])
            cv2.line(image, *line, paint, wide, cv2.LINE_AA)
        elif kind < 0.65:
            cv2.circle(
                image, a, int(rng.integers(15, 200)), paint, wide if rng.random() < 0.7 else -1, cv2.LINE_AA
            )
        elif kind < 0.8:
            cv2.rectangle(image, a, b, paint, wide if rng.random() < 0.6 else -1)
        else:
            text = "".join(chr(c) for c in rng.integers(65, 91, int(rng.integers(1, 6))))
            letters(image, text, a, rng.uniform(1, 5), paint, wide)
    return image


def cloth(rng: np.random.Generator) -> Texture:
    """Sofas, curtains, bed covers, folds included."""
    image = carpet(rng)
    if rng.random() < 0.5:
        folds = np.sin(2 * np.pi * rng.uniform(3, 20) * np.linspace(0, 1, SIDE_PX) + noise(rng, (3,))[0])
        image = image * np.exp(rng.uniform(0.05, 0.5) * folds)[None, :, None]
    return np.clip(image, 0.005, 1.0).astype(np.float32)


def wall(rng: np.random.Generator) -> Texture:
    """Paint, wallpaper, bricks, pictures, doors, shelves: rectangles upon rectangles."""
    image = np.ones((SIDE_PX, SIDE_PX, 3), np.float32) * colour(rng, 0.4, 0.97, 0.15)
    if rng.random() < 0.15:
        image = tiles(rng)
    for _ in range(int(rng.integers(0, 9))):
        w, h = (int(v) for v in rng.integers(15, 200, 2))
        x, y = (int(v) for v in rng.integers(0, SIDE_PX, 2))
        pick = rng.random()
        if pick < 0.2:  # a clock, a sign, a hoop, a lamp
            wide = -1 if rng.random() < 0.6 else int(rng.integers(2, 12))
            cv2.ellipse(image, (x, y), (w // 3, max(4, int(w * rng.uniform(0.1, 0.35)))), 0, 0, 360,
                        colour(rng).tolist(), wide, cv2.LINE_AA)  # fmt: skip
            if rng.random() < 0.4:
                word = "".join(chr(c) for c in rng.integers(65, 91, int(rng.integers(1, 9))))
                letters(image, word, [x - w // 4, y + 4], rng.uniform(0.3, 1.2), colour(rng).tolist(), 2)
            continue
        cv2.rectangle(image, (x, y), (x + w, y + h), colour(rng).tolist(), -1)
        if pick < 0.4:  # a shelf of books and boxes, a radiator
            step, k = int(rng.integers(4, 24)), x
            even = rng.random() < 0.3
            while k < x + w:
                high = 0 if even else int(rng.uniform(0, 0.5) * h)
                paint = (0.6, 0.6, 0.6) if even else colour(rng).tolist()
                cv2.rectangle(image, (k, y + high), (k + max(2, step - 2), y + h), paint, -1)
                k += step if even else max(3, int(step * rng.uniform(0.5, 1.5)))
        if rng.random() < 0.6:
            cv2.rectangle(image, (x, y), (x + w, y + h), colour(rng).tolist(), int(rng.integers(1, 8)))
        if rng.random() < 0.3:
            for k in range(1, int(rng.integers(2, 7))):
                yy = int(y + k * h / 6)
                cv2.line(image, (x, yy), (x + w, yy), (0.03, 0.03, 0.03), 1)
    return np.clip(image * np.exp(0.02 * noise(rng, (4, 64)))[:, :, None], 0.005, 1.0).astype(np.float32)


FLOORS = (planks, planks, planks, parquet, tiles, tiles, carpet, carpet, stone)
