"""Floor plans from files, read with distrust: ``importers`` ROS maps, ``image_files`` what shows one."""
