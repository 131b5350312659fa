"""Batch sender: attempts wait for the batches of a run."""

from __future__ import annotations

from dataclasses import dataclass

from merge_runner.llm.batch.rounds import Rounds
from merge_runner.llm.budget import Reservation
from merge_runner.llm.call import Call, Wait
from merge_runner.llm.sender import Sent


@dataclass(slots=True)
class BatchSender:
    """Sender of attempts of a model, by its name in the registry, in the rounds of a run."""

    rounds: Rounds
    model: str
    price_factor: float = 1.0

    def takes(self, call: Call) -> bool:
        """Return whether the next attempt of a call goes into a batch, or waits in one already."""
        is_new = self.rounds.submits and not call.bypass_batch
        return is_new or call.pending_batch is not None

    def resume(self, call: Call) -> None:
        """Take the attempt that goes on in a batch out of the recorded attempts of a call."""
        if call.pending_batch is not None:
            end = call.pending_batch.note.lines[call.request.key]
            call.attempts = [a for a in call.attempts if a.number < end]
            call.earlier = len(call.attempts)

    async def send(self, call: Call, reservation: Reservation) -> Sent:
        """Wait for the outcome of a call in its batch or in the next round."""
        call.wait = Wait(f"for batches of {self.model}", blocked=True, charged=True)
        number = len(call.attempts) + 1
        outcome, batch = await self.rounds.outcome_of(
            call.request, number, reservation, self.model, call.pending_batch
        )
        call.wait, call.pending_batch, call.bypass_batch = None, None, True
        note = batch.note
        return Sent(outcome, note.submitted_at, batch_id=note.batch_id or None, error=batch.error)
