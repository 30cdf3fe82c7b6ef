"""A small ray tracer for training pictures: a room, boxes, round things, soft shadows and shiny floors.

Compiled with numba (a tool's dependency, never the package's). Metres, radians, linear colour. Its tables:

primitive: kind, x, y, z (of the base's middle; a ball's centre), cos yaw, sin yaw, a, b, c, material of
the side, material of the top, object number. BOX: half length, half width, height; ROUND: radius below,
radius above, height; BALL: half axes. material: r, g, b, texture (-1: none), texture side in m, shininess,
gloss, mirror, roughness, mapping (0 by place, 1 the cap's own square), two spare. overlay on the floor: shape
(0 rectangle, 1 ellipse, 2 ring), x, y, cos, sin, half length, half width, its width, material. window: wall
(0..3), u0, u1, v0, v1 in m along the wall and above the floor, brightness, panes along u and v.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

BOX, ROUND, BALL = 0.0, 1.0, 2.0
_FAR = 1e9
_SKIN = 1e-4


@njit(cache=True, fastmath=True)
def _box(ox, oy, oz, dx, dy, dz, p):
    lx, ly = ox - p[1], oy - p[2]
    x, y, z = lx * p[4] + ly * p[5], -lx * p[5] + ly * p[4], oz - p[3] - 0.5 * p[8]
    u, v, w = dx * p[4] + dy * p[5], -dx * p[5] + dy * p[4], dz
    near, far, axis, sign = -_FAR, _FAR, 0, 1.0
    for k in range(3):
        o = x if k == 0 else (y if k == 1 else z)
        d = u if k == 0 else (v if k == 1 else w)
        h = p[6] if k == 0 else (p[7] if k == 1 else 0.5 * p[8])
        if abs(d) < 1e-9:
            if abs(o) > h:
                return _FAR, 0.0, 0.0, 0.0
            continue
        t0, t1 = (-h - o) / d, (h - o) / d
        s = -1.0
        if t0 > t1:
            t0, t1 = t1, t0
            s = 1.0
        if t0 > near:
            near, axis, sign = t0, k, s
        far = min(far, t1)
    if near > far or near < _SKIN:
        return _FAR, 0.0, 0.0, 0.0
    if axis == 2:
        return near, 0.0, 0.0, sign
    a, b = (sign, 0.0) if axis == 0 else (0.0, sign)
    return near, a * p[4] - b * p[5], a * p[5] + b * p[4], 0.0


@njit(cache=True, fastmath=True)
def _round(ox, oy, oz, dx, dy, dz, p):
    x, y, z = ox - p[1], oy - p[2], oz - p[3]
    r0, height = p[6], p[8]
    k = (p[7] - r0) / height
    best, nx, ny, nz = _FAR, 0.0, 0.0, 0.0
    # r(z) = r0 + k z
    a = dx * dx + dy * dy - (k * dz) ** 2
    rz = r0 + k * z
    b = x * dx + y * dy - k * dz * rz
    c = x * x + y * y - rz * rz
    if abs(a) > 1e-12:
        disc = b * b - a * c
        if disc > 0.0:
            root = math.sqrt(disc)
            for s in (-1.0, 1.0):
                t = (-b + s * root) / a
                at = z + t * dz
                if _SKIN < t < best and 0.0 <= at <= height and r0 + k * at > 0.0:
                    best = t
                    hx, hy = x + t * dx, y + t * dy
                    n = 1.0 / math.sqrt((hx * hx + hy * hy) * (1.0 + k * k) + 1e-12)
                    nx, ny = hx * n, hy * n
                    nz = -k / math.sqrt(1.0 + k * k)
    if abs(dz) > 1e-9:
        for top in range(2):
            t = ((height if top else 0.0) - z) / dz
            r = p[7] if top else r0
            hx, hy = x + t * dx, y + t * dy
            if _SKIN < t < best and hx * hx + hy * hy <= r * r:
                best, nx, ny, nz = t, 0.0, 0.0, (1.0 if top else -1.0)
    return best, nx, ny, nz


@njit(cache=True, fastmath=True)
def _ball(ox, oy, oz, dx, dy, dz, p):
    lx, ly = ox - p[1], oy - p[2]
    x, y, z = (lx * p[4] + ly * p[5]) / p[6], (-lx * p[5] + ly * p[4]) / p[7], (oz - p[3]) / p[8]
    u, v, w = (dx * p[4] + dy * p[5]) / p[6], (-dx * p[5] + dy * p[4]) / p[7], dz / p[8]
    a, b, c = u * u + v * v + w * w, x * u + y * v + z * w, x * x + y * y + z * z - 1.0
    disc = b * b - a * c
    if disc <= 0.0:
        return _FAR, 0.0, 0.0, 0.0
    t = (-b - math.sqrt(disc)) / a
    if t < _SKIN:
        return _FAR, 0.0, 0.0, 0.0
    a, b, c = (x + t * u) / p[6], (y + t * v) / p[7], (z + t * w) / p[8]
    n = 1.0 / math.sqrt(a * a + b * b + c * c)
    return t, (a * p[4] - b * p[5]) * n, (a * p[5] + b * p[4]) * n, c * n


@njit(cache=True, fastmath=True)
def _hit(ox, oy, oz, dx, dy, dz, prims, spheres, most):
    """Nearest primitive before `most`: its index (-1: none), distance and normal."""
    best, index, bx, by, bz = most, -1, 0.0, 0.0, 0.0
    for i in range(len(prims)):
        s = spheres[i]
        cx, cy, cz = s[0] - ox, s[1] - oy, s[2] - oz
        along = cx * dx + cy * dy + cz * dz
        off = cx * cx + cy * cy + cz * cz - along * along
        if off > s[3] or (along < 0.0 and cx * cx + cy * cy + cz * cz > s[3]):
            continue
        p = prims[i]
        if p[0] == BOX:
            t, nx, ny, nz = _box(ox, oy, oz, dx, dy, dz, p)
        elif p[0] == ROUND:
            t, nx, ny, nz = _round(ox, oy, oz, dx, dy, dz, p)
        else:
            t, nx, ny, nz = _ball(ox, oy, oz, dx, dy, dz, p)
        if t < best:
            best, index, bx, by, bz = t, i, nx, ny, nz
    return index, best, bx, by, bz


@njit(cache=True, fastmath=True)
def _wall(ox, oy, oz, dx, dy, dz, room):
    """Where a ray leaves the room: face (0..3 walls, 4 floor, 5 ceiling) and distance."""
    best, face = _FAR, 4
    for k in range(3):
        o = ox if k == 0 else (oy if k == 1 else oz)
        d = dx if k == 0 else (dy if k == 1 else dz)
        if d > 1e-9:
            t = (room[2 * k + 1] - o) / d
            f = 2 * k + 1
        elif d < -1e-9:
            t = (room[2 * k] - o) / d
            f = 2 * k
        else:
            continue
        if t < best:
            best, face = t, f
    return face, best


@njit(cache=True, fastmath=True)
def _texel(textures, index, u, v, footprint):
    """Bilinear, mirrored; the level is chosen by the footprint in texels."""
    level = 0 if footprint < 1.2 else (1 if footprint < 4.0 else 2)
    image = textures[index, level]
    size = image.shape[0]
    u, v = abs(u) % 2.0, abs(v) % 2.0
    u, v = (2.0 - u if u > 1.0 else u) * (size - 1), (2.0 - v if v > 1.0 else v) * (size - 1)
    i, j = min(int(u), size - 2), min(int(v), size - 2)
    a, b = u - i, v - j
    r = g = s = 0.0
    for di in range(2):
        for dj in range(2):
            w = (a if di else 1.0 - a) * (b if dj else 1.0 - b)
            texel = image[j + dj, i + di]
            r += w * texel[0]
            g += w * texel[1]
            s += w * texel[2]
    return r, g, s


@njit(cache=True, fastmath=True)
def _colour(m, textures, x, y, z, nx, ny, nz, prim, distance, pixel, cap):
    r, g, b = m[0], m[1], m[2]
    index = int(m[3])
    if index >= 0:
        if m[9] == 1.0 and cap:
            lx, ly = x - prim[1], y - prim[2]
            radius = max(prim[7], 1e-3) if prim[0] == ROUND else max(prim[6], prim[7])
            u = 0.5 + 0.5 * (lx * prim[4] + ly * prim[5]) / radius
            v = 0.5 + 0.5 * (-lx * prim[5] + ly * prim[4]) / radius
            side = 2.0 * radius
        else:
            side = m[4]
            if abs(nz) > 0.7:
                u, v = x / side, y / side
            elif abs(nx) > abs(ny):
                u, v = y / side, z / side
            else:
                u, v = x / side, z / side
        footprint = distance * pixel / side * textures.shape[2]
        a, c, d = _texel(textures, index, u, v, footprint)
        r, g, b = r * a, g * c, b * d
    return r, g, b


@njit(cache=True, fastmath=True)
def _surface(ox, oy, oz, dx, dy, dz, prims, spheres, mats, overlays, windows, textures, room, pixel):
    """What a ray sees: distance, normal, colour, light of its own, gloss (4), object."""
    face, far = _wall(ox, oy, oz, dx, dy, dz, room)
    i, t, nx, ny, nz = _hit(ox, oy, oz, dx, dy, dz, prims, spheres, far)
    glow = 0.0
    if i >= 0:
        p = prims[i]
        cap = nz > 0.9
        m = mats[int(p[10] if cap else p[9])]
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        r, g, b = _colour(m, textures, x, y, z, nx, ny, nz, p, t, pixel, cap)
        return t, nx, ny, nz, r, g, b, glow, m[5], m[6], m[7], m[8], p[11]
    t = far
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    nx = 1.0 if face == 0 else (-1.0 if face == 1 else 0.0)
    ny = 1.0 if face == 2 else (-1.0 if face == 3 else 0.0)
    nz = 1.0 if face == 4 else (-1.0 if face == 5 else 0.0)
    m = mats[face]
    if face == 4:
        for k in range(len(overlays)):
            q = overlays[k]
            lx, ly = x - q[1], y - q[2]
            a, b = lx * q[3] + ly * q[4], -lx * q[4] + ly * q[3]
            if q[0] == 0.0:
                inside = abs(a) < q[5] and abs(b) < q[6]
            else:
                e = math.sqrt((a / q[5]) ** 2 + (b / q[6]) ** 2)
                inside = e < 1.0 and (q[0] == 1.0 or e > 1.0 - q[7] / q[5])
            if inside:
                m = mats[int(q[8])]
    elif face < 4:
        u = y if face < 2 else x
        if z < room[6]:
            m = mats[6]
        for k in range(len(windows)):
            w = windows[k]
            if int(w[0]) == face and w[1] < u < w[2] and w[3] < z < w[4]:
                a = (u - w[1]) / (w[2] - w[1]) * w[6] % 1.0
                b = (z - w[3]) / (w[4] - w[3]) * w[7] % 1.0
                if 0.04 < a < 0.96 and 0.04 < b < 0.96:
                    glow = w[5]
                m = mats[7]
    r, g, b = _colour(m, textures, x, y, z, nx, ny, nz, prims[0], t, pixel, False)
    return t, nx, ny, nz, r, g, b, glow, m[5], m[6], m[7], m[8], -1.0


@njit(cache=True, fastmath=True)
def _sun(x, y, z, sun, prims, spheres, windows, room):
    """Whether the sun comes through a window to here."""
    face, far = _wall(x, y, z, sun[0], sun[1], sun[2], room)
    if face > 3:
        return 0.0
    hx, hy, hz = x + far * sun[0], y + far * sun[1], z + far * sun[2]
    u = hy if face < 2 else hx
    for k in range(len(windows)):
        w = windows[k]
        if int(w[0]) == face and w[1] < u < w[2] and w[3] < hz < w[4]:
            a = (u - w[1]) / (w[2] - w[1]) * w[6] % 1.0
            b = (hz - w[3]) / (w[4] - w[3]) * w[7] % 1.0
            if 0.04 < a < 0.96 and 0.04 < b < 0.96:
                i, _, _, _, _ = _hit(x, y, z, sun[0], sun[1], sun[2], prims, spheres, far)
                return 1.0 if i < 0 else 0.0
    return 0.0


@njit(cache=True, fastmath=True)
def _light(x, y, z, nx, ny, nz, prims, spheres, windows, room, lamps, sun, ambient, hard):
    """White light that falls on a point; `hard` leaves shadows and contact darkening out."""
    total = ambient
    if not hard:
        # One ray over the hemisphere: what is near darkens.
        a, b = 2.0 * math.pi * np.random.random(), np.random.random()
        s = math.sqrt(1.0 - b * b)
        ux, uy, uz = s * math.cos(a) + nx, s * math.sin(a) + ny, (b if nz >= 0 else -b) + nz
        n = 1.0 / math.sqrt(ux * ux + uy * uy + uz * uz + 1e-9)
        i, t, _, _, _ = _hit(x, y, z, ux * n, uy * n, uz * n, prims, spheres, 0.8)
        if i >= 0:
            total *= 0.15 + 0.85 * t / 0.8
    for k in range(len(lamps)):
        q = lamps[k]
        lx = q[0] + q[4] * (np.random.random() - 0.5) - x
        ly = q[1] + q[5] * (np.random.random() - 0.5) - y
        lz = q[2] + q[6] * (np.random.random() - 0.5) - z
        d = math.sqrt(lx * lx + ly * ly + lz * lz)
        lx, ly, lz = lx / d, ly / d, lz / d
        cosine = lx * nx + ly * ny + lz * nz
        if cosine <= 0.0:
            continue
        if not hard:
            i, _, _, _, _ = _hit(x, y, z, lx, ly, lz, prims, spheres, d)
            if i >= 0:
                continue
        total += q[3] * cosine / (0.5 + d * d)
    if sun[3] > 0.0:
        cosine = sun[0] * nx + sun[1] * ny + sun[2] * nz
        if cosine > 0.0:
            total += sun[3] * cosine * _sun(x, y, z, sun, prims, spheres, windows, room)
    return total


@njit(cache=True, fastmath=True)
def render(
    prims,
    spheres,
    mats,
    overlays,
    windows,
    textures,
    room,
    lamps,
    sun,
    ambient,
    camera,
    width,
    height,
    samples,
    seed,
):
    """(height, width, 3) linear colour and (height, width) object numbers (-1: none).

    camera: position (3), then the rows right, down, forward (9), focal length in pixels, principal point.
    room: x0, x1, y0, y1, z0, z1 and the height of the skirting. lamps: x, y, z, power, extent along x, y, z.
    sun: unit vector to it, power.
    """
    np.random.seed(seed)
    image = np.zeros((height, width, 3), np.float32)
    objects = np.full((height, width), -1, np.int16)
    pixel = 1.0 / camera[12]
    for row in range(height):
        for column in range(width):
            for sample in range(samples):
                jx, jy = (0.5, 0.5) if sample == 0 else (np.random.random(), np.random.random())
                a = (column + jx - camera[13]) * pixel
                b = (row + jy - camera[14]) * pixel
                dx = a * camera[3] + b * camera[6] + camera[9]
                dy = a * camera[4] + b * camera[7] + camera[10]
                dz = a * camera[5] + b * camera[8] + camera[11]
                n = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
                dx, dy, dz = dx * n, dy * n, dz * n
                ox, oy, oz = camera[0], camera[1], camera[2]
                t, nx, ny, nz, r, g, s, glow, shine, gloss, mirror, rough, number = _surface(
                    ox, oy, oz, dx, dy, dz, prims, spheres, mats, overlays, windows, textures, room, pixel
                )
                if sample == 0:
                    objects[row, column] = int(number)
                if glow > 0.0:
                    image[row, column] += np.float32(glow)
                    continue
                x, y, z = ox + t * dx + _SKIN * nx, oy + t * dy + _SKIN * ny, oz + t * dz + _SKIN * nz
                light = _light(x, y, z, nx, ny, nz, prims, spheres, windows, room, lamps, sun, ambient, False)
                r, g, s = r * light, g * light, s * light
                if mirror > 0.0:
                    mx = nx + rough * (np.random.random() - 0.5)
                    my = ny + rough * (np.random.random() - 0.5)
                    mz = nz + rough * (np.random.random() - 0.5)
                    n = 1.0 / math.sqrt(mx * mx + my * my + mz * mz)
                    mx, my, mz = mx * n, my * n, mz * n
                    c = -(dx * mx + dy * my + dz * mz)
                    rx, ry, rz = dx + 2 * c * mx, dy + 2 * c * my, dz + 2 * c * mz
                    if rx * nx + ry * ny + rz * nz > 0.0:
                        share = mirror * (0.12 + 0.88 * (1.0 - min(1.0, max(c, 0.0))) ** 4)
                        t2, ax, ay, az, r2, g2, s2, glow2, _, _, _, _, _ = _surface(
                            x,
                            y,
                            z,
                            rx,
                            ry,
                            rz,
                            prims,
                            spheres,
                            mats,
                            overlays,
                            windows,
                            textures,
                            room,
                            pixel,
                        )
                        if glow2 > 0.0:
                            r2 = g2 = s2 = glow2
                        else:
                            far = _light(
                                x + t2 * rx, y + t2 * ry, z + t2 * rz, ax, ay, az,
                                prims, spheres, windows, room, lamps, sun, 0.8 * ambient, True,
                            )  # fmt: skip
                            r2, g2, s2 = r2 * far, g2 * far, s2 * far
                        r, g, s = (
                            r * (1 - share) + share * r2,
                            g * (1 - share) + share * g2,
                            s * (1 - share) + share * s2,
                        )
                if gloss > 0.0:
                    for k in range(len(lamps)):
                        q = lamps[k]
                        lx, ly, lz = q[0] - x, q[1] - y, q[2] - z
                        d = 1.0 / math.sqrt(lx * lx + ly * ly + lz * lz)
                        hx, hy, hz = lx * d - dx, ly * d - dy, lz * d - dz
                        n = 1.0 / math.sqrt(hx * hx + hy * hy + hz * hz)
                        c = (hx * nx + hy * ny + hz * nz) * n
                        if c > 0.0:
                            add = gloss * c**shine * q[3] * d * d
                            r, g, s = r + add, g + add, s + add
                image[row, column, 0] += np.float32(r)
                image[row, column, 1] += np.float32(g)
                image[row, column, 2] += np.float32(s)
    return image / np.float32(samples), objects
