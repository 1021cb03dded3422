"""``mecanum benchmark``: agents × backends × suites × seeds.

``suites`` say what is run, ``run`` runs it, an ``episode`` a row, ``store`` keeps the rows, ``figures`` sums them
up. ``tables`` are made of those, for ``output``, ``report`` with its ``report_charts``, and ``leaderboard``;
``parquet`` is for other programs. ``team_episode`` runs several robots, ``team_figures`` say what more bring.
"""
