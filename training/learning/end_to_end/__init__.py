"""Training of ``ppo``, which drives from the observation straight to the twist.

``run`` goes through rounds of ``lessons`` learned by ``imitation``, then ``ppo``; ``rollouts`` are the episodes.
"""
