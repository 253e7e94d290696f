"""The simulator and the navigator as ROS 1 nodes; nothing else of the project needs ROS.

`python -m topological_nav.ros all SCENE ...` brings up a master, both nodes and a recorder; docs/ros.md has topics,
units and frames. `messages` (pure) and `simulator` run without ROS; `debian` is where ROS comes in.
"""
