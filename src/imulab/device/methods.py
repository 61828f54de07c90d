"""The methods by which the C core fuses an array."""

METHODS = ("mean", "support", "least-squares", "feedback", "robust", "covariance", "kalman")
