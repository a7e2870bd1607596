"""What an attempt adds to the farm's counters (see `pileus_service.measures`)."""

from pileus_service.jobs import Kind
from pileus_worker import child


def account(
    kind: Kind, outcome: child.Finished | child.Failed | None, seconds: float, threads: int
) -> dict[str, float]:
    """Counters by name and labels; no outcome is an attempt that was given up, not failed."""
    if outcome is None:
        return {f"attempts {kind} given_up": 1}
    spent = outcome.spent
    amounts = {
        f"attempts {kind} {'done' if isinstance(outcome, child.Finished) else 'failed'}": 1.0,
        "core_seconds": seconds * threads,
        "cpu_seconds": spent.cpu_seconds,
        "cache_read_bytes": float(spent.cache_bytes),
    }
    if isinstance(outcome, child.Failed):
        amounts[f"failures {outcome.cause}"] = 1.0
    phases = {f"phase_seconds {phase}": value for phase, value in spent.phases.items()}
    # Orders, leases, a new child: what the supervisor saw and the child did not.
    phases["phase_seconds other"] = max(0.0, seconds - sum(spent.phases.values()))
    return amounts | phases
