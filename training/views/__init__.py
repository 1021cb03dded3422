"""What an episode leaves behind for people and other tools.

``episode_files`` writes all of it: ``report_page`` the replay in a browser, ``film`` the MP4, ``mcap_file`` ROS 2
messages, ``rerun_file`` a Rerun recording; ``moving_picture`` is the README's. ``team_files`` and ``team_page``
are of several robots.
"""
