"""Run the simulator and the navigator as ROS 2 nodes.

Only this package needs ROS, and only when a node starts: `pip install 'interactive-nav[ros2]'`. See `docs/ros.md`.
"""
