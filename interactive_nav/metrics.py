"""Compute the Interactive Navigation Score (Xia et al. 2020, section IV) of NumPy or JAX arrays of any batch axes."""

from interactive_nav_common.rotations import Array, namespace

GRAVITY = 9.81
"""m/s^2."""


def path_efficiency(success: Array, shortest_path_m: Array, robot_path_m: Array, clip: bool = True) -> Array:
    """Return P_eff = 1_suc * L* / l_0 [...] in [0, 1] (paper section IV; with alpha = 1 the INS is SPL).

    `shortest_path_m`, not negative, is L* among static structure only. A goal is a region, so a robot may succeed on a
    path shorter than L*, for which `clip` counts 1. A robot that succeeds without moving scores 1.
    """
    xp = namespace(success, shortest_path_m, robot_path_m)
    shortest = xp.asarray(shortest_path_m) * 1.0
    travelled = xp.asarray(robot_path_m) * 1.0
    moved = travelled > 0.0
    ratio = xp.where(moved, shortest / xp.where(moved, travelled, 1.0), 1.0)
    return xp.where(xp.asarray(success) > 0, xp.clip(ratio, 0.0, 1.0 if clip else None), 0.0)


def kinematic_effort(masses_kg: Array, path_lengths_m: Array) -> Array:
    """Return m_0 l_0 / sum_i m_i l_i [...] in [0, 1]: the robot's share of the moved mass (paper section IV).

    Masses and path lengths of the centres of mass are [..., K+1], the robot first. It is 1 where nothing moved.
    """
    xp = namespace(masses_kg, path_lengths_m)
    work = xp.asarray(masses_kg) * xp.asarray(path_lengths_m) * 1.0
    total = work.sum(-1)
    moved = total > 0.0
    return xp.where(moved, work[..., 0] / xp.where(moved, total, 1.0), 1.0)


def dynamic_effort(robot_mass_kg: Array, force_sum_n: Array, num_steps: Array, gravity: float = GRAVITY) -> Array:
    """Return T G / (T G + sum_t F_t) [...] in (0, 1] with G = m_0 g (paper section IV).

    `force_sum_n` [...] is the sum over T control steps of the force on everything but the floor. With T = 0 and no
    force the term is 1.
    """
    xp = namespace(robot_mass_kg, force_sum_n, num_steps)
    weight = xp.asarray(robot_mass_kg) * gravity * xp.asarray(num_steps)
    total = weight + xp.asarray(force_sum_n)
    some = total > 0.0
    return xp.where(some, weight / xp.where(some, total, 1.0), 1.0)


def effort_efficiency(
    masses_kg: Array, path_lengths_m: Array, forces_n: Array, num_steps: Array, gravity: float = GRAVITY
) -> Array:
    """Return E_eff [...] in [0, 1], the mean of `kinematic_effort` and `dynamic_effort` (paper section IV).

    Padded objects have path length 0; `forces_n` [..., T] of every control step are 0 after the episode's end.
    """
    xp = namespace(masses_kg, path_lengths_m, forces_n, num_steps)
    dynamic = dynamic_effort(xp.asarray(masses_kg)[..., 0], xp.asarray(forces_n).sum(-1), num_steps, gravity)
    return 0.5 * (kinematic_effort(masses_kg, path_lengths_m) + dynamic)


def interactive_navigation_score(p_eff: Array, e_eff: Array, alpha: float | Array) -> Array:
    """Return INS_alpha = alpha P_eff + (1 - alpha) E_eff [...] in [0, 1] (paper section IV).

    The effort counts on failures too. Raise `ValueError` for a Python number `alpha` outside [0, 1].
    """
    if isinstance(alpha, (int, float)) and not 0.0 <= alpha <= 1.0:
        raise ValueError(f"alpha is {alpha}, expected a weight in [0, 1]")
    return alpha * p_eff + (1.0 - alpha) * e_eff
