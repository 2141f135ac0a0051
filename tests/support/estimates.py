"""What tests ask of the estimate of the error."""

from sonar_gl.engine import error_model


def record_estimates(monkeypatch) -> list:
    """Return a list that grows with each view whose bodies are counted: one or two in an estimate of the error."""
    estimates, count = [], error_model.count_bodies
    monkeypatch.setattr(error_model, "count_bodies", lambda *args: estimates.append(1) or count(*args))
    return estimates
