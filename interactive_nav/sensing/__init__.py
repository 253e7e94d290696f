"""Render depth, class ids and distances for cameras and scanners; `make_renderer` picks the renderer."""

from interactive_nav.scenes.world import World
from interactive_nav.sensing.base import Renderer
from interactive_nav.sensing.boxes import BoxTables, build_boxes
from scenes_mjcf.look import CameraPose, Lens, look_along


def make_renderer(tables: BoxTables, lens: Lens, name: str, backend: str, meshes: World | None = None) -> Renderer:
    """Build a renderer: warp (MJX-Warp's), rays (plain JAX), or auto: warp beside physics on warp, rays elsewhere.

    With `meshes`, a Warp kernel draws visual meshes instead of boxes, whatever the name.
    """
    from interactive_nav.physics import resolve_backend

    if meshes is not None:
        resolve_backend("warp")
        from interactive_nav.sensing.meshes import MeshRenderer

        return MeshRenderer(tables, lens, meshes)
    if name == "warp" or (name == "auto" and backend == "warp"):
        resolve_backend("warp")
        from interactive_nav.sensing.warp import WarpRenderer

        return WarpRenderer(tables, lens)
    from interactive_nav.sensing.rays import RayRenderer

    return RayRenderer(tables, lens)


__all__ = ["BoxTables", "CameraPose", "Lens", "Renderer", "build_boxes", "look_along", "make_renderer"]
