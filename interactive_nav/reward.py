"""One control step's events in, the reward and its named terms out (paper section V-A).

R = R_suc + R_pot + R_int. Pure functions on NumPy or JAX arrays with any leading batch axes.
"""

from interactive_nav_common.errors import ConfigError
from interactive_nav_common.rotations import Array, namespace


def success_reward(success: Array, success_value: float = 10.0) -> Array:
    """R_suc (paper section V-A): `success_value` on the step that reaches the goal, else 0.

    Args:
        success: [...] 1 or True on that step.
        success_value: no unit.

    Returns:
        [...] 0 or `success_value`.
    """
    return namespace(success).asarray(success) * success_value


def potential_reward(geodesic_before_m: Array, geodesic_after_m: Array) -> Array:
    """R_pot = GD_{t-1} - GD_t (paper section V-A): geodesic progress among static structure.

    Args:
        geodesic_before_m: [...] distance to the goal before the step, metres.
        geodesic_after_m: [...] after it, metres.

    Returns:
        [...] metres, negative where the robot went away; over an episode it adds up to first less last distance.
    """
    xp = namespace(geodesic_before_m, geodesic_after_m)
    return xp.asarray(geodesic_before_m) - xp.asarray(geodesic_after_m)


def interaction_reward(interacts: Array, k_int: float) -> Array:
    """R_int = -k_int * 1_int (paper section V-A), for a step in which the robot interacts with objects.

    Args:
        interacts: [...] 1 or True on such a step.
        k_int: penalty, no unit; the paper's are 0, 0.1 and 1.

    Returns:
        [...] -k_int or 0.
    """
    return -k_int * namespace(interacts).asarray(interacts)


def interactive_navigation_reward(
    success: Array,
    geodesic_before_m: Array,
    geodesic_after_m: Array,
    interacts: Array,
    k_int: float,
    success_value: float = 10.0,
) -> tuple[Array, dict[str, Array]]:
    """R = R_suc + R_pot + R_int, paper section V-A.

    Args:
        success: [...] 1 on the step that reaches the goal (once an episode).
        geodesic_before_m: [...] distance to the goal before the step.
        geodesic_after_m: [...] after it.
        interacts: [...] 1 if the robot touched a movable object in any physics substep.
        k_int: interaction penalty, not negative.
        success_value: reward of success.

    Returns:
        The sum [...], and its terms under `success`, `potential`, `interaction`.

    Raises:
        ConfigError: k_int is a negative Python number.
    """
    if isinstance(k_int, (int, float)) and k_int < 0:
        raise ConfigError(f"k_int is {k_int}, expected a penalty >= 0 (it is subtracted)")
    terms = {
        "success": success_reward(success, success_value),
        "potential": potential_reward(geodesic_before_m, geodesic_after_m),
        "interaction": interaction_reward(interacts, k_int),
    }
    return terms["success"] + terms["potential"] + terms["interaction"], terms
