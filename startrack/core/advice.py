"""Advice that fits a message better than that of its reason."""

from __future__ import annotations

ADVICE_BY_MESSAGE = {  # part of a message: what to do
    "or a sidecar with terrain": "A picture from the Earth needs no terrain for its stars (startrack identify) and its "
    "skyline (startrack horizon).",
    "no such folder of results": "Give the folder OUT of startrack locate or batch, or one NAME.fix.json.",
    "images there": "Give the folder that holds the pictures.",
}


def fitting_advice(message: str) -> str | None:
    """What to do after a refusal with this `message`; None where the advice of its reason fits."""
    return next((advice for part, advice in ADVICE_BY_MESSAGE.items() if part in message), None)
