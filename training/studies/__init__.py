"""Studies: questions asked of the estimators, the agents and the code, each with a command.

``consistency``, ``complexity`` and ``speed`` measure estimators and the step, ``paper_b``, ``paper_c`` and
``paper_d`` repeat the papers' claims, ``peers`` are other simulators under the same load.
"""
