"""A batch mode in memory that misbehaves as a test says."""

import asyncio
from collections import Counter

from merge_runner.llm.batch.service import BatchFailed, BatchStatus
from merge_runner.llm.formats import FORMATS
from tests.support.clients import answer


class Memory:
    """A provider's batch mode, of which each batch ends at the first look.

    ``fates`` are replies to lines by repetition, one after the other: None is an expiry, and what
    is "missing" has no result. ``creations`` and ``states`` are raised or returned in their order
    before the usual. ``partial`` looks at the results show one of them alone. At the ``step`` that
    it has, it says so by ``died``, and where that is about a creation, it answers no more.
    """

    takes_mark = True
    wire = FORMATS["openai-chat"]

    def __init__(self):
        self.batches, self.marks, self.fates = {}, {}, {}
        self.creations, self.states = [], []
        self.answered = Counter()
        self.partial = 0
        self.step, self.died = "", asyncio.Event()

    async def dies(self, step):
        if self.step == step:
            self.died.set()
            await asyncio.Event().wait()

    async def create(self, lines, mark):
        await self.dies("before the creation")
        step = self.creations.pop(0) if self.creations else None
        if isinstance(step, BatchFailed) and not step.sent:
            raise step
        batch_id = f"batch-{len(self.batches)}"
        self.batches[batch_id] = list(lines)
        self.marks[batch_id] = mark
        if step is not None:
            raise step
        await self.dies("after the creation")
        return batch_id

    async def find(self, mark):
        return next((each for each, its in self.marks.items() if its == mark), None)

    async def status(self, batch_id):
        if batch_id not in self.batches:
            raise BatchFailed("lost", "HTTP 404: no such batch", sent=False)
        if self.step == "while it waits":
            self.step = ""
            self.died.set()
            return BatchStatus()
        step = self.states.pop(0) if self.states else BatchStatus([batch_id])
        if isinstance(step, BatchFailed):
            raise step
        return step

    async def results(self, paths):
        for line in reversed(self.batches[paths[0]]):
            repetition = line.slot.repetition
            fates = self.fates.get(repetition, [])
            fate = fates.pop(0) if fates else answer(f"batched {repetition}")
            if fate == "missing":
                continue
            if fate is not None and fate.status == 200:
                self.answered[line.key] += 1
            yield line.key, fate
            if self.partial:
                self.partial -= 1
                return

    @property
    def sizes(self):
        return [len(lines) for lines in self.batches.values()]
