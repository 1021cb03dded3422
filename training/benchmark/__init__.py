"""``mecanum benchmark``: agents × backends × suites × seeds.

``suites`` say what is run, ``run`` runs it, ``store`` keeps the rows, ``figures`` sums them up; ``output``,
``markdown``, ``report`` and ``leaderboard`` show them. ``evaluate`` and ``ratios`` are tables of the studies.
"""
