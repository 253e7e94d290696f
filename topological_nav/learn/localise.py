"""Embeddings in, places out: which node of a map an image was taken nearest to."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np


def nearest_node(queries: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the node with the nearest embedding over all images of all nodes, and the distance to that image.

    Queries [Q, D] and nodes [N, K, D] give [Q] i32 nodes, of equals the first, and [Q] f32 Euclidean distances.
    """
    # In double precision: images of neighbouring nodes differ by less than single precision loses here.
    queries, flat = queries.astype(float), nodes.reshape(-1, nodes.shape[-1]).astype(float)
    best = squares_between(queries, flat).argmin(1)
    gap = np.linalg.norm(queries - flat[best], axis=-1)
    return (best // nodes.shape[1]).astype(np.int32), gap.astype(np.float32)


def squares_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the squared distances [n, m] of rows [n, D] and [m, D]."""
    return (a**2).sum(-1)[:, None] + (b**2).sum(-1) - 2.0 * a @ b.T


def in_words(scores: Mapping[str, float]) -> str:
    """Scores of `localisation_scores`, or means of them."""
    return (
        f"nearest node {scores['node']:.3f}, right room {scores['room']:.3f}, "
        f"median error {scores['error_m']:.2f} m (least possible {scores['least_error_m']:.2f} m)"
    )


def nearest_turn(angle_rad: np.ndarray, count: int) -> np.ndarray:
    """[...] int: which of so many headings, evenly from the world's x axis on, is nearest to each angle."""
    return np.rint(angle_rad / (2 * np.pi) * count).astype(int) % count


class Places(NamedTuple):
    """Embeddings [N, K, D] of K images at each of N places, their positions [N, 2] (m) and rooms [N]."""

    embeddings: np.ndarray
    xy_w: np.ndarray
    room: np.ndarray


def localisation_scores(queries: Places, nodes: Places) -> dict[str, float]:
    """Return how well `nearest_node` does in one scene.

    `node` is the share of queries given the node that is nearest in truth; `room`: share given a node of their own
    room; `error_m`: median distance to the node given; `least_error_m`: the same for the nearest in truth.
    """
    each = queries.embeddings.shape[1]
    xy_w, room = np.repeat(queries.xy_w, each, 0), np.repeat(queries.room, each)
    node, _ = nearest_node(queries.embeddings.reshape(-1, queries.embeddings.shape[-1]), nodes.embeddings)
    away = np.linalg.norm(xy_w[:, None] - nodes.xy_w, axis=-1)
    return {
        "node": float((node == away.argmin(1)).mean()),
        "room": float((nodes.room[node] == room).mean()),
        "error_m": float(np.median(away[np.arange(len(node)), node])),
        "least_error_m": float(np.median(away.min(1))),
    }
