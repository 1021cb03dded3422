"""Several robots map one building: what they tell each other, and what can be made of it.

What one tells the others is its account (:mod:`slam.accounts`). ``alignment`` finds where one's frame lies in
another's, from candidates by ``constellation`` that ``contradiction`` rules out by free space; ``sighting`` says
it by one robot seeing another. ``fusion`` makes one map of accounts, from scratch each time and never fed back,
by the Gaussian in ``joint``; ``frames`` takes poses, points and walls from one frame into another.
``merged_grid`` is a map of cells of one's own and others' together; ``centralised`` is one filter over all
robots, whose turns the kernels of ``turns`` pass on; ``apart`` is what one keeps that maps alone until its start
is known.
"""
