"""ROS bags: where their messages lie, which topics are cameras, and what the messages hold."""
