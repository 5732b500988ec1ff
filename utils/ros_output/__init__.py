"""Bags of ROS 1 without ROS: events, camera, poses and clouds for programs that read them (package rosbags)."""
