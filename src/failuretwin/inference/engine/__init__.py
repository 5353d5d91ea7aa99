"""The one likelihood: moments, theta, outcomes and an integral in the numbers of a moment.

    p(run | h) = sum over rows of p(row | h)  integral of prod over m of L_m(G_m theta + H_m z)

Read in this order; each module states its term:

    integral       one moment under one row: evidence, mean and covariance of f, in closed form
    filter         moment by moment, and every moment again given all others
    moments        settled positions and readings on the way -> moments
    theta          shared parameters: registration, offsets, joint frames, lags; scatter and noise
    outcomes       outcomes of a moment: residual and scale
    rows           discrete parts of a hypothesis
    moved_motor    a motor that a fault moves by one amount
    held_rows, offset_rows, redrawn_rows    rows by signature
    picks, runs    rows by components of the robot: the evidence of every hypothesis
    posterior      posterior of onset, size and theta
    weighing       all hypotheses by runs whose theta is a mixture of normal distributions
    registration   runs of any robot, calibrated or not; a sensor that may be displaced
    scatter        evidence on the scatter of the motors

Healthy, held, constant, growing and redrawn faults have rows, for calibrated robots too. The nodes
of `movements` and `faults` weigh streams, wrong set-ups at rest and isolability. They also weigh
faults that show on the way, pairs and unknown faults, at the most probable theta.
"""
