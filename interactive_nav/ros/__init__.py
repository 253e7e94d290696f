"""Connect policies and simulated robots to ROS 2: `pip install 'interactive-nav[ros2]'`; see `docs/ros.md`."""
