"""Estimators: a session in, a term with covariance and diagnostics out."""
