"""Write a navigator's networks as ONNX files that map images to embeddings, logits and velocities."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from interactive_nav import get_robot
from interactive_nav.config import SensorConfig
from interactive_nav.interop.onnx_file import convert
from interactive_nav.sensing.description import describe_input
from interactive_nav_common.versions import versions
from topological_nav.drives.driving import TrainedPolicy
from topological_nav.drives.expert import CONTROL_S
from topological_nav.learn.training import Networks

_STEP = ("embedding", "linear_memory", "angular_memory", "twist", "next_linear_memory", "next_angular_memory")
"""Inputs and outputs of a policy."""


def onnx_models(networks: Networks, driver: TrainedPolicy | None, images: np.ndarray) -> dict[str, bytes]:
    """Return ONNX models of networks and policy by name, compared with JAX's on image sequences [P, K, H, W, 3] u8."""
    inputs, models = {"image": images.reshape(-1, *images.shape[2:])}, {}
    for task, network in zip(("rooms", "passages"), networks, strict=True):
        bound = network.network.bind(network.variables)
        outputs = {"embedding": network.embed(inputs["image"]), "logits": network.logits(inputs["image"])}
        names = [f"free to {length} m" for length in network.about.get("lengths_m", ())] or network.about["names"]
        about = _describe(networks, network.about, inputs, outputs, {"logits": {"names": names}})
        models[task] = convert(lambda x, of=bound: (of.embed(x), of(x)), inputs, outputs, about)
    if driver is not None:
        speeds = [jnp.asarray(driver.about[name], jnp.float32) for name in ("linear_m_s", "angular_rad_s")]

        def step(embedding: Any, *memory: Any) -> Any:
            after, classes = driver.step(memory, embedding)
            return jnp.stack([of[one] for of, one in zip(speeds, classes, strict=True)], -1), *after

        state, rows = driver.start(len(images)), []
        for image in images.swapaxes(0, 1):
            before, (state, *velocity) = state, driver.act(state, image)
            embedding = np.concatenate([n.embed(image) for n in networks], -1)
            rows.append((embedding, *before, np.stack(velocity, -1), *state))
        parts = [(name, np.concatenate(of)) for name, of in zip(_STEP, zip(*rows, strict=True), strict=True)]
        inputs, outputs = dict(parts[:3]), dict(parts[3:])
        limits = {end: [float(of(speed)) for speed in speeds] for end, of in (("low", min), ("high", max))}
        twist = {"names": ["linear.x m/s", "angular.z rad/s"], "unit": "m/s, rad/s", "frame": "base", **limits}
        models["policy"] = convert(
            step, inputs, outputs, _describe(networks, driver.about, inputs, outputs, {"twist": twist})
        )
    return models


def _describe(networks: Networks, network: Any, inputs: Any, outputs: Any, facts: Any) -> dict[str, Any]:
    """Describe a model in the format of policies; `facts` describe outputs by name."""
    data, rate = networks.camera, {"rate_hz": 1.0 / CONTROL_S}
    robot = get_robot(data.robot, "twist")
    sizes = {"width": data.width, "height": data.height, "vertical_fov_deg": networks.localiser.about["fov_deg"]}
    angles = {"yaw_deg": 0.0, "pitch_down_deg": math.degrees(robot.camera.pitch_rad)}
    place = {"inputs": "image", "body": robot.camera.body, "pos_m": list(map(float, robot.camera.pos_m))}
    picture = np.zeros((data.height, data.width, 3), np.uint8)
    facts = {"image": describe_input("image/rgb", picture, SensorConfig()), **facts}

    def described(values: Any) -> dict[str, Any]:
        plain = {"unit": "1", "frame": "", "range": None, **rate}
        shapes = {name: {"shape": x.shape[1:], "dtype": str(x.dtype)} for name, x in values.items()}
        return {name: plain | of | facts.get(name, {}) for name, of in shapes.items()}

    return {
        "robot": {"name": robot.name, "control_mode": robot.control_mode, **rate},
        "inputs": described(inputs),
        "outputs": described(outputs),
        "cameras": [place | angles | sizes],
        "network": {name: network[name] for name in ("task", "digest")} | {"export_commit": versions()["commit"]},
    }
