"""The simulator and the navigator as ROS 1 nodes; nothing else of the project needs ROS.

`python -m topological_nav.ros all scene:=SCENE` has roslaunch start `episode.launch`; docs/ros.md has topics,
units and frames. `messages` (pure) and `simulator` run without ROS; `debian` is where ROS comes in.
"""
