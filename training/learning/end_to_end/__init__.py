"""Training of the agent ppo, which drives from the observation straight to the twist.

``config`` says what is trained; ``run`` goes through rounds of ``lessons`` learned by ``imitation``, then ``ppo``;
``rollouts`` are the episodes, ``networks`` what learns.
"""
