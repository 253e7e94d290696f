"""An episode's bookkeeping in, its scores out: what `InteractiveNav` reports on an episode's last step."""

import jax
import jax.numpy as jnp

from interactive_nav import metrics as scores
from interactive_nav.config import TaskRules
from interactive_nav.navigation.placement import DISTANCE_TOLERANCE_M
from interactive_nav.scenes.world import World
from interactive_nav.types import NavInfo, SceneTables


def score_mass_kg(world: World, rules: TaskRules) -> float:
    """m_0 as the scores take it, kg."""
    total, base = world.robot_mass_kg, float(world.models[0].body_mass[world.layout.robot_bodies[0]])
    return {"total": total, "links": total - world.robot.root_link_kg, "base": base}[rules.robot_mass]


def off_distance(nav: NavInfo, rules: TaskRules) -> jax.Array:
    """[] bool: the episode's start and goal are nearer or farther than the settings ask."""
    near = jnp.linalg.norm(nav.start_xy_w - nav.goal_xy_w) < rules.min_goal_distance_m - DISTANCE_TOLERANCE_M
    return near | (nav.shortest_path_m > rules.max_goal_distance_m + DISTANCE_TOLERANCE_M)


def episode_scores(
    nav: NavInfo, rules: TaskRules, tables: SceneTables, mass_kg: float, success: jax.Array, broken: jax.Array
) -> dict[str, jax.Array]:
    """`EPISODE_METRICS` of an episode so far.

    Args:
        mass_kg: m_0, of `score_mass_kg`.
    """
    masses = tables.mass_kg[nav.scene_index].at[0].set(mass_kg)
    paths = jnp.concatenate([nav.robot_path_m[None], nav.object_path_m])
    p_eff = scores.path_efficiency(success, nav.shortest_path_m, nav.robot_path_m, rules.clip_path_efficiency)
    kinematic = scores.kinematic_effort(masses, paths)
    dynamic = scores.dynamic_effort(mass_kg, nav.force_sum_n, nav.step_count, rules.score_gravity_m_s2)
    counts = 1.0 if rules.effort_on_failure else jnp.asarray(success, jnp.float32)
    kinematic, dynamic = counts * kinematic, counts * dynamic
    e_eff = 0.5 * (kinematic + dynamic)
    values = {
        "success": success,
        "path_efficiency": p_eff,
        "effort_efficiency": e_eff,
        "kinematic_effort": kinematic,
        "dynamic_effort": dynamic,
        "ins_0.5": scores.interactive_navigation_score(p_eff, e_eff, 0.5),
        "robot_path_m": nav.robot_path_m,
        "shortest_path_m": nav.shortest_path_m,
        "object_displacement_kg_m": jnp.sum(masses[1:] * nav.object_path_m),
        "force_sum_n": nav.force_sum_n,
        "episode_steps": nav.step_count,
        "nonfinite": broken,
        "interaction_steps": nav.interaction_steps,
        "structure_steps": nav.structure_steps,
        "overflow_steps": nav.overflow_steps,
        "left_out_steps": nav.left_out_steps,
        "unconverged_steps": nav.unconverged_steps,
        "objects_dropped": nav.objects_dropped,
        "off_distance": off_distance(nav, rules),
        "lifted": nav.lifted_steps > 0,
    }
    return {name: jnp.asarray(value, jnp.float32) for name, value in values.items()}
