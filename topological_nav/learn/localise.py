"""Embeddings in, places out: which node of a map an image was taken nearest to."""

from collections.abc import Mapping

import numpy as np


def nearest_node(queries: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The node with the nearest embedding, over all images of all nodes.

    Args:
        queries: [Q, D] embeddings.
        nodes: [N, K, D] embeddings of each node's images.

    Returns:
        [Q] i32 nodes, of equals the first, and [Q] f32 Euclidean distances to their nearest image.
    """
    # In double precision: images of neighbouring nodes differ by less than single precision loses here.
    queries, flat = queries.astype(float), nodes.reshape(-1, nodes.shape[-1]).astype(float)
    squares = (queries**2).sum(-1)[:, None] + (flat**2).sum(-1) - 2.0 * queries @ flat.T
    best = squares.argmin(1)
    gap = np.linalg.norm(queries - flat[best], axis=-1)
    return (best // nodes.shape[1]).astype(np.int32), gap.astype(np.float32)


def in_words(scores: Mapping[str, float]) -> str:
    """Scores of `localisation_scores`, or means of them."""
    return (
        f"nearest node {scores['node']:.3f}, right room {scores['room']:.3f}, "
        f"median error {scores['error_m']:.2f} m (least possible {scores['least_error_m']:.2f} m)"
    )


def nearest_turn(angle_rad: np.ndarray, count: int) -> np.ndarray:
    """[...] int: which of so many headings, evenly from the world's x axis on, is nearest to each angle."""
    return np.rint(angle_rad / (2 * np.pi) * count).astype(int) % count


def localisation_scores(
    queries: np.ndarray,
    query_xy_w: np.ndarray,
    query_room: np.ndarray,
    nodes: np.ndarray,
    node_xy_w: np.ndarray,
    node_room: np.ndarray,
) -> dict[str, float]:
    """How well `nearest_node` does in one scene.

    Args:
        queries: [Q, K, D] of K images at each of Q places.
        query_xy_w: [Q, 2] m, where they were taken.
        query_room: [Q].
        nodes: [N, K, D].
        node_xy_w: [N, 2] m.
        node_room: [N].

    Returns:
        `node`: share of queries given the node that is nearest in truth; `room`: share given a node of their own
        room; `error_m`: median distance to the node given; `least_error_m`: the same for the nearest in truth.
    """
    each = queries.shape[1]
    query_xy_w, query_room = np.repeat(query_xy_w, each, 0), np.repeat(query_room, each)
    found, _ = nearest_node(queries.reshape(-1, queries.shape[-1]), nodes)
    away = np.linalg.norm(query_xy_w[:, None] - node_xy_w, axis=-1)
    return {
        "node": float((found == away.argmin(1)).mean()),
        "room": float((node_room[found] == query_room).mean()),
        "error_m": float(np.median(away[np.arange(len(found)), found])),
        "least_error_m": float(np.median(away.min(1))),
    }
