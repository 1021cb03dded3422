"""Floor plans from files: ROS map_server maps and plain images, read with distrust."""
