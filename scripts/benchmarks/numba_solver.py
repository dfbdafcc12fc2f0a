"""The yardstick's algorithm pixel by pixel, as scalar code for numba: only arrays, loops and numbers."""

from __future__ import annotations

import math

import numpy as np


def solve_all(images, s, c, tolerance, limit, local):
    """LM on every pixel from `local` (4, pixels), in place."""
    n, pixels = images.shape
    zero, one = np.float32(0), np.float32(1)
    n_s = c[5 * n]
    x, t, step = np.empty(4, np.float32), np.empty(4, np.float32), np.empty(4, np.float32)
    g, V = np.zeros(4, np.float32), np.zeros((4, 4), np.float32)
    g2, V2, L = np.zeros(4, np.float32), np.zeros((4, 4), np.float32), np.zeros((4, 4), np.float32)
    J = np.empty(4, np.float32)
    for i in range(pixels):
        for k in range(4):
            t[k] = local[k, i]
        cost, mu = np.float32(3e38), np.float32(1e-3)
        for iteration in range(limit + 1):
            promised = zero
            if iteration > 0:
                trace = V[0, 0] + V[1, 1] + V[2, 2] + V[3, 3]
                for k in range(4):
                    for m in range(k + 1):
                        L[k, m] = V[k, m]
                    L[k, k] += mu * max(V[k, k], np.float32(1e-9) * trace + np.float32(1e-30))
                # Cholesky, forward and back substitution
                for k in range(4):
                    for m in range(k):
                        L[k, k] -= L[k, m] * L[k, m]
                    L[k, k] = math.sqrt(max(L[k, k], np.float32(1e-20)))
                    for r in range(k + 1, 4):
                        for m in range(k):
                            L[r, k] -= L[r, m] * L[k, m]
                        L[r, k] /= L[k, k]
                for k in range(4):
                    step[k] = g[k]
                    for m in range(k):
                        step[k] -= L[k, m] * step[m]
                    step[k] /= L[k, k]
                for k in range(3, -1, -1):
                    for m in range(k + 1, 4):
                        step[k] -= L[m, k] * step[m]
                    step[k] /= L[k, k]
                for k in range(4):
                    promised += step[k] * (g[k] + mu * V[k, k] * step[k])
                    t[k] = x[k] - step[k]
                t[3] = min(max(t[3], np.float32(-7)), np.float32(7))
                promised *= np.float32(0.5)
            B, trial = math.exp(t[3]), zero
            for k in range(4):
                g2[k] = zero
                for m in range(4):
                    V2[k, m] = zero
            for j in range(n):
                y, root = zero, zero
                for k in range(3):
                    y += c[3 * j + k] * t[k]
                    root += c[3 * j + k] * (t[k] + s[k, i])
                u, w = c[3 * n + j] + B * y, c[4 * n + j]
                p = u ** (n_s - one) if u > zero else zero
                f = n_s * p * B
                r = max(root, zero) + p * max(u, zero) - images[j, i]
                q = f + one if root > zero else f
                for k in range(3):
                    J[k] = c[3 * j + k] * q
                J[3] = f * y
                trial += w * r * r
                for k in range(4):
                    g2[k] += w * J[k] * r
                    for m in range(k + 1):
                        V2[k, m] += w * J[k] * J[m]
            trial *= np.float32(0.5)
            before = cost
            if trial < cost:
                cost = trial
                for k in range(4):
                    x[k], g[k] = t[k], g2[k]
                    for m in range(k + 1):
                        V[k, m] = V2[k, m]
                if iteration > 0:
                    mu = max(mu * np.float32(0.2), np.float32(1e-9))
            elif iteration > 0:
                mu *= np.float32(5)
            if iteration > 0 and (promised <= tolerance * before + np.float32(1e-12) or mu > np.float32(1e9)):
                break
        for k in range(4):
            local[k, i] = x[k]
