"""What runs say of each hypothesis: laws of faults, priors, sums over all that is unknown."""
