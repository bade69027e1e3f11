"""What do the counts say?  Likelihood, fit, goodness of fit and posterior of one particle."""
