"""Robots that hop over a lattice of stations and look only where they stop (the dungeons protocol).

``lattice`` are the stations, ``sensor`` what a look shows, ``survey`` what there is to do, ``stop`` what a robot
makes of its belief at one.
"""
