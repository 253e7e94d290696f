"""URDF text for tests: a cart of 13.2 kg, and links and joints to add to it."""

INERTIA = '<inertia ixx="{0}" iyy="{0}" izz="{0}" ixy="0" ixz="0" iyz="0"/>'


def link(name, shape="", mass=None, at="0 0 0", inertia=None):
    """A URDF link with a collision shape and, unless None, a mass."""
    body = f'<collision><origin xyz="{at}"/><geometry>{shape}</geometry></collision>' if shape else ""
    if mass is not None:
        inertia = 0.01 * mass if inertia is None else inertia
        body += f'<inertial><origin xyz="{at}"/><mass value="{mass}"/>{INERTIA.format(inertia)}</inertial>'
    return f'<link name="{name}">{body}</link>'


def joint(name, kind, parent, child, at="0 0 0", rpy="0 0 0", axis="0 0 1", limit=""):
    """A URDF joint."""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{at}" rpy="{rpy}"/><axis xyz="{axis}"/>{limit}</joint>'
    )


def cart(extra="", wheel="continuous", limit='<limit effort="5" velocity="10"/>', base=None):
    """A robot of 13.2 kg: base, two wheels of radius 0.07 m, two casters."""
    parts = [base or link("base_link", '<box size="0.4 0.3 0.1"/>', 12, "0 0 0.1")]
    for side, y in (("left", 0.18), ("right", -0.18)):
        parts.append(link(f"{side}_wheel", '<cylinder radius="0.07" length="0.04"/>', 0.5))
        parts.append(
            joint(f"{side}_joint", wheel, "base_link", f"{side}_wheel", f"0 {y} 0.07", "-1.5708 0 0", limit=limit)
        )
    for end, x in (("front", 0.15), ("rear", -0.15)):
        parts.append(link(f"{end}_caster", '<sphere radius="0.03"/>', 0.1))
        parts.append(joint(f"{end}_fix", "fixed", "base_link", f"{end}_caster", f"{x} 0 0.03"))
    return f'<robot name="cart">{"".join(parts)}{extra}</robot>'
