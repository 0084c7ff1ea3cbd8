"""A bundle compiled onto its two tapes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dtwin.schema import Floats
from dtwin.serve.band import fade, fade_many
from dtwin.serve.bundle import Bundle
from dtwin.serve.graph import Graph
from dtwin.serve.interface import SafetyLimits
from dtwin.serve.tape import Tape


class CompiledBundle:
    """Evaluates a bundle tick by tick; allocates nothing after construction.

    ``fades``: whether a correction smaller than its own uncertainty fades out, where the bundle's band allows it.
    """

    def __init__(self, bundle: Bundle, *, fades: bool = True) -> None:
        self.bundle = bundle
        self.fades = fades and bundle.band is not None and bundle.band.fades
        ticks, held = len(bundle.tick_inputs), bundle.feature_inputs + bundle.intermediates
        outputs = tuple(o.name for o in bundle.outputs)
        self._tape = Tape(bundle.tick_graph, bundle.tick_inputs + held, bundle.initial_state, outputs)
        self._window_tape = (
            Tape(bundle.window_graph, bundle.feature_inputs, {}, bundle.intermediates)
            if bundle.window_graph is not None
            else None
        )
        self._n_tick = ticks
        self._inputs = self._tape.inputs
        self._features = self._inputs[ticks : ticks + len(bundle.feature_inputs)]
        self._held = self._inputs[ticks + len(bundle.feature_inputs) :]
        self.tick_inputs = self._inputs[:ticks]
        """Inputs of the next tick, in the order of ``Bundle.tick_inputs``; filled in place."""
        self.outputs = self._tape.outputs
        """Outputs of the newest tick; a view that the next one overwrites."""
        self.evaluate = self._tape.evaluate
        """Evaluate one tick from ``tick_inputs`` into ``outputs``."""
        self._band_tape: Tape | None = None
        self.band_um = np.full(len(outputs), np.nan)
        """Half width of each output, k = 2, um, of the newest tick; NaN where the bundle has no band."""
        if bundle.band is not None:
            self._prepare_band(bundle.band.graph, outputs)

    def _prepare_band(self, graph: Graph, outputs: tuple[str, ...]) -> None:
        names = self.bundle.tick_inputs + self.bundle.feature_inputs + self.bundle.intermediates
        tape = Tape(graph, names, {}, outputs)
        tape.evaluate()
        self.band_um = tape.outputs
        fade(np.zeros(len(outputs)), self.band_um)
        self._band_tape = tape if graph.inputs else None
        # What is the same at every tick was evaluated now.
        if graph.inputs or self.fades:
            self._plain, self.evaluate = self._tape.evaluate, self._evaluate_with_band

    def _evaluate_with_band(self) -> None:
        self._plain()
        if self._band_tape is not None:
            self._band_tape.inputs[:] = self._inputs
            self._band_tape.evaluate()
        if self.fades:
            fade(self.outputs, self.band_um)

    def limited(self, safety: SafetyLimits) -> CompiledBundle:
        """Return the same model under other limits."""
        return CompiledBundle(replace(self.bundle, safety=safety), fades=self.fades)

    @property
    def told(self) -> dict[str, float]:
        """What the newest window told, by name of the intermediate."""
        return dict(zip(self.bundle.intermediates, self._held.tolist(), strict=True))

    def reset(self) -> None:
        """Return to the state before the first tick and forget the newest window."""
        self._tape.reset()
        self._inputs[:] = 0.0

    def window(self, features: Floats) -> None:
        """Take the features of a new window; they are held until the next.

        ``features``, shape (n_feature_inputs,): in the order of ``Bundle.feature_inputs``.
        """
        self._features[:] = features
        if self._window_tape is not None:
            self._held[:] = self._window_tape.run(self._features)

    def tick(self, inputs: Floats) -> Floats:
        """Evaluate one tick; return the outputs, a view that the next tick overwrites.

        ``inputs``, shape (n_tick_inputs,): in the order of ``Bundle.tick_inputs``.
        """
        if len(inputs) != self._n_tick:
            raise ValueError(f"{len(inputs)} inputs given, {self._n_tick} wanted")
        self.tick_inputs[:] = inputs
        self.evaluate()
        return self.outputs

    def run(self, inputs: Floats) -> Floats:
        """Evaluate successive ticks through the state, with the features of the newest window; return outputs, shape (n, n_outputs).

        ``inputs``, shape (n, n_tick_inputs): one row per tick.
        """
        rows = np.empty((len(inputs), len(self._inputs)))
        rows[:] = self._inputs
        rows[:, : self._n_tick] = inputs
        out = self._tape.run_many(rows)
        if self.fades:
            half = (
                np.broadcast_to(self.band_um, out.shape) if self._band_tape is None else self._band_tape.run_many(rows)
            )
            fade_many(out, np.ascontiguousarray(half))
        return out
