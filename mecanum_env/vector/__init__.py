"""Many environments at once, on all cores: what ``gym.make_vec`` makes of ``mecanum_env/Explore-v0``.

``vector_env`` is Gymnasium's side of it; ``workers`` are the processes, each of which steps its share of the
environments; ``board`` is the memory they share, so that a step sends no observation through a pipe.
"""
