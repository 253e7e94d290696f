"""Run the navigator as a ROS 2 node: `pip install 'interactive-nav[ros2]'`; see `docs/ros.md`."""
