"""German for what a certificate says of the data: clause by clause, a clause with ``{}`` where numbers and names stand.

Clauses end at ``;`` and at a full stop. A text of which one clause is not here stays English as a whole.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache

CLAUSES: Mapping[str, str] = {
    "{} is evaluated, though not sound: {}": "{} ist ausgewertet, obwohl nicht einwandfrei: {}",
    "{} is not evaluated: {}": "{} ist nicht ausgewertet: {}",
    "{} has a tolerance, and this test does not tell it": "{} hat eine Toleranz, doch dieser Test sagt es nicht",
    "{} of {} conditions have no repeat: their noise floor is unknown": "{} von {} Bedingungen sind nicht wiederholt: ihr Rauschen ist unbekannt",
    "{} of {} conditions were run in one direction only": "{} von {} Bedingungen wurden nur in einer Richtung gefahren",
    "the clock runs backwards or stands still at sample {}": "die Uhr läuft rückwärts oder steht bei Wert {}",
    "{} gap(s) in the clock, about {} samples lost, the first at {} s": "{} Lücke(n) in der Zeit, etwa {} Werte fehlen, die erste bei {} s",
    "the samples are those of run {} to the last digit: a copy is no repeat, and would say that there is no noise": "die Werte sind bis zur letzten Ziffer die des Laufs {}: eine Kopie ist keine Wiederholung und täuschte vor, es gäbe kein Rauschen",
    "campaign.toml states {} {}, the file {}": "campaign.toml nennt {} {}, die Datei {}",
    "the file is used": "die Datei gilt",
    # Circles.
    "it has no radius or direction": "Radius oder Richtung fehlen",
    "the file has no angles": "die Datei hat keine Winkel",
    "they are computed from the programmed feed": "sie sind aus dem programmierten Vorschub berechnet",
    "the window marked as a full circle is about {} deg: {} samples are marked, the true period is {}": "das als Vollkreis markierte Fenster umfasst etwa {}°: {} Werte sind markiert, die wahre Periode hat {}",
    "the file's angles are misregistered by up to {} deg against the stops": "die Winkel der Datei sind gegen die Halte der Maschine um bis zu {}° versetzt",
    "the {} feed is {} mm/min, {} % of the programmed {}": "der {} Vorschub beträgt {} mm/min, das sind {} % gegenüber programmierten {}",
    "a wrong feed, or a radius in another unit": "ein falscher Vorschub oder ein Radius in anderer Einheit",
    "arcs of {}° tell centre and radius badly": "Bögen von {}° bestimmen Mitte und Radius schlecht",
    "ISO 230-4 has F about a least-squares centre, and D, of whole circles only: no limit of theirs is decided": "ISO 230-4 kennt F um eine Ausgleichsmitte und D nur für Vollkreise: über ihre Grenzen wird nicht entschieden",
    "a deviation of {} µm is beyond any ball bar: wrong unit, or the ball was lost": "eine Abweichung von {} µm misst kein Kugelstab: falsche Einheit, oder die Kugel ging verloren",
    "the angle runs against the stated direction {}": "der Winkel läuft gegen die angegebene Richtung {}",
    "the angle jumps by {} deg at sample {}": "der Winkel springt um {}° bei Wert {}",
    "the angle runs over {} deg, and all of it is evaluated: leave rows of run-in and run-out out of the table": "der Winkel läuft über {}°, und alles ist ausgewertet: Zeilen von Einlauf und Auslauf aus der Tabelle nehmen",
    "all deviations are off by {} µm, alike to within {} µm: a datum, such as an instrument whose length is not calibrated, or a radius other than the one stated": "alle Abweichungen liegen um {} µm daneben, gleich auf {} µm: ein Nullpunkt, etwa ein Messgerät mit nicht kalibrierter Länge, oder ein anderer Radius als angegeben",
    "G does not count it, Fmax, Fmin and D do": "G zählt das nicht, Fmax, Fmin und D schon",
    "repeats of a condition differ by {} µm RMS after centre and radius, readings within a run scatter by {} µm: the set-up or the machine moves between runs (a bar that is not seated, a cooler that switches, heat), and faults smaller than that are not seen": "Wiederholungen einer Bedingung unterscheiden sich nach Mitte und Radius um {} µm (Effektivwert), Werte innerhalb eines Laufs streuen um {} µm: Aufstellung oder Maschine bewegen sich zwischen den Läufen (Stab sitzt nicht, ein Kühler schaltet, Wärme), kleinere Fehler sind nicht zu sehen",
    "Seat the bar anew, warm the machine up, note what switches, and repeat one condition five times in a row until repeats agree": "Stab neu einsetzen, Maschine warmfahren, notieren, was schaltet, und eine Bedingung fünfmal hintereinander wiederholen, bis die Läufe gleich sind",
    "one of both was written in another unit than it is read in": "eines von beiden ist in anderer Einheit geschrieben als gelesen",
    "{} and {} have one shape, and the first is {} times as large: about {}, as between units (mm, µm, inch)": "{} und {} haben eine Form, und das erste ist {}-mal so groß: etwa {}, wie zwischen Einheiten (mm, µm, Zoll)",
    # Axes.
    "one run only: repeatability and noise floor are unknown": "nur ein Lauf: Wiederholpräzision und Rauschen sind unbekannt",
    "it has one direction only": "nur eine Richtung ist gemessen",
    "its runs share no target": "die Läufe haben keine gemeinsame Zielposition",
    "the targets were approached {} only: play cannot be seen": "die Zielpositionen wurden nur {} angefahren: Spiel ist nicht zu sehen",
    "ISO 230-2 asks for {} targets on this travel, these are {}": "ISO 230-2 verlangt {} Zielpositionen auf diesem Weg, hier sind es {}",
    "ISO 230-2 asks for five runs, {}": "ISO 230-2 verlangt fünf Läufe, {}",
    "this is one": "hier ist es einer",
    "this is one, and tells no repeatability": "hier ist es einer, der keine Wiederholpräzision ergibt",
    "these are {}": "hier sind es {}",
    "the heads are of deviations, and the values follow the targets: they are read as positions": "die Köpfe nennen Abweichungen, doch die Werte folgen den Zielpositionen: sie sind als Positionen gelesen",
    "R as the larger of R↑ and R↓ would be {} {}": "R als das größere von R↑ und R↓ wäre {} {}",
    "the standard's has the reversal in it": "das der Norm enthält die Umkehrspanne",
    "E from the higher of both minima would be {} {}": "E vom höheren der beiden Minima wäre {} {}",
    "the standard takes the lowest of all means": "die Norm nimmt das kleinste aller Mittel",
    "an error of {} {} is beyond any axis: wrong unit, a lost beam, or the instrument was not zeroed at the first target": "einen Fehler von {} {} hat keine Achse: falsche Einheit, Strahl verloren, oder an der ersten Zielposition nicht genullt",
    "{} equal errors in a row: the beam was broken or the instrument not read": "{} gleiche Fehler hintereinander: Strahl unterbrochen oder Messgerät nicht abgelesen",
    "{} readings of {} are missing, the first at {} {}: window too small, or the dwell too short": "{} von {} Ablesungen fehlen, die erste bei {} {}: Fenster zu klein oder Halt zu kurz",
    "{} targets were read more than once in one sweep": "{} Zielpositionen wurden in einer Fahrt mehrmals abgelesen",
    "{} of {} readings carry a status other than 0": "{} von {} Ablesungen haben einen anderen Status als 0",
    "the step of {} mm meets the screw (pitch {} mm) at {} only: its cyclic error is folded into the slow error, and a table made of this does not see it": "der Schritt von {} mm trifft die Spindel (Steigung {} mm) nur an {}: ihr zyklischer Fehler erscheint als langsamer, und eine Tabelle daraus sieht ihn nicht",
    "the runs disagree by drift, not by noise: {} {} RMS wander from run to run, {} {} RMS from one reading to the next": "die Läufe unterscheiden sich durch Drift, nicht durch Rauschen: {} {} (Effektivwert) von Lauf zu Lauf, {} {} von Ablesung zu Ablesung",
    "R counts it as scatter, and more runs do not average it away": "R zählt das als Streuung, und mehr Läufe mitteln es nicht heraus",
    "Ordinary air, heat and mounting of the instrument: let both settle, shield the beam": "Luft, Wärme und Halterung des Messgeräts, wie üblich: beide ruhen lassen, den Strahl schirmen",
    "A coupling or an encoder that slips irregularly, lost steps, or heat: mark the coupling, compare the axis's own encoder with the reference, log temperatures": "Eine Kupplung oder ein Geber rutscht unregelmäßig, Schritte gehen verloren, oder Wärme: Kupplung markieren, den Geber der Achse mit dem Messgerät vergleichen, Temperaturen aufzeichnen",
    "cycle {}": "Zyklus {}",
    "Up to {} {} of B and E may be this, too, if it goes on between the directions of a cycle": "Bis zu {} {} von B und E können auch daher kommen, wenn es zwischen den Richtungen eines Zyklus weitergeht",
    "from {} all readings move by {}, alike at all targets, neither steadily nor settling: the zero of the instrument or of the axis wanders (air, mounting), or a coupling slips or steps are lost now and then": "von {} wandern alle Ablesungen um {}, an allen Zielpositionen gleich, weder stetig noch abklingend: der Nullpunkt von Messgerät oder Achse wandert (Luft, Halterung), oder eine Kupplung rutscht oder Schritte gehen hin und wieder verloren",
    "readings settle with a time constant of about {} cycles, by {} {} in the middle and {} {} more from one end to the other: warming, or cooling": "die Ablesungen klingen mit einer Zeitkonstante von etwa {} Zyklen ab, um {} {} in der Mitte und {} {} mehr von einem Ende zum anderen: Erwärmung oder Abkühlung",
    "measure that sweep again, or leave that cycle out": "diese Fahrt neu messen, oder den Zyklus weglassen",
    "{} reading{} {} not belong to the others ({}): R is {} {} with {} and {} {} without": "{0} Ablesung(en) gehören nicht zu den anderen ({3}): R ist damit {4} {5}, ohne {7} {8}",
    "cycle {} {} at {} {}: {} {} from the other {}, which agree within {} {}": "Zyklus {} {} bei {} {}: {} {} von den anderen {} entfernt, die auf {} {} übereinstimmen",
    "cycles differ: {}": "die Zyklen unterscheiden sich: {}",
    "the zero moves by {} {} each cycle, alike at all targets: a coupling or an encoder that slips, or lost steps in every cycle": "der Nullpunkt wandert je Zyklus um {} {}, an allen Zielpositionen gleich: Kupplung oder Geber rutschen, oder Schritte gehen in jedem Zyklus verloren",
    "not warming, which would settle and stretch": "keine Erwärmung, denn die käme zur Ruhe und dehnte",
    "from {} on all readings lie {} {} off, alike at all targets: lost steps, or something that moved once": "ab {} liegen alle Ablesungen um {} {} daneben, an allen Zielpositionen gleich: verlorene Schritte, oder etwas hat sich einmal bewegt",
    "not backlash, which is the same in every cycle": "keine Umkehrspanne, denn die ist in jedem Zyklus gleich",
    "every cycle reads exactly 0 {}: the instrument was set to zero there in each cycle": "jeder Zyklus zeigt genau 0 {}: dort wurde in jedem Zyklus genullt",
    "that is a datum, no accuracy: a zero that moves from cycle to cycle (slip, lost steps) is not in the table, and what that one reading scatters by is in all others": "das ist ein Nullpunkt, keine Genauigkeit: ein von Zyklus zu Zyklus wandernder Nullpunkt (Rutschen, verlorene Schritte) fehlt in der Tabelle, und die Streuung dieser einen Ablesung steckt in allen anderen",
    # Drift.
    "no sample was read twice: no noise floor is known": "kein Messzeitpunkt wurde zweimal abgelesen: das Rauschen ist unbekannt",
    "no sample was read twice": "kein Messzeitpunkt wurde zweimal abgelesen",
    "U takes what readings that follow each other scatter by": "U nimmt die Streuung aufeinander folgender Ablesungen",
    "no hour holds two readings, so the range in one hour is not known": "keine Stunde hat zwei Ablesungen, die Spanne in einer Stunde ist daher unbekannt",
    "no temperature was logged: how far it drifted is told, and not what it follows": "keine Temperatur ist aufgezeichnet: bekannt ist, wie weit es driftete, nicht wovon",
    "{}: tilts are left out, figures and twins are of displacements": "{}: Neigungen sind weggelassen, Kenngrößen und Zwillinge gelten für Verlagerungen",
    "the displacement never changes: is the probe stuck, or out of its range?": "die Verlagerung ändert sich nie: klemmt der Taster, oder ist er außerhalb seines Bereichs?",
    "{} jump{} between neighbouring readings, the largest {} µm after {} min: lost reference, or a probing that went wrong": "{0} Sprung/Sprünge zwischen benachbarten Ablesungen, der größte {2} µm nach {3} min: Bezug verloren oder falsch angetastet",
    "nothing is to be fitted to this run": "an diesen Lauf ist nichts anzupassen",
    # Robots.
    "no pose was measured twice: the noise floor cannot be known, nor what is significant": "keine Pose wurde zweimal gemessen: weder das Rauschen ist bekannt noch, was sich davon abhebt",
    "the times of the rows are not known: t_s is the number of the row, and drift over time is not judged": "die Zeiten der Zeilen sind nicht bekannt: t_s ist die Nummer der Zeile, Drift über die Zeit ist nicht beurteilt",
    "{} tells no unit, and holds no dates of a known form: write {} [s]": "{} nennt keine Einheit und enthält keine Zeitangaben bekannter Form: als {} [s] schreiben",
    "AP and AD are of what is left by the best {}": "AP und AD gelten für den Rest nach Ausgleich von {}",
    "as the file has its errors, AP is {} µm": "mit den Fehlern, wie sie in der Datei stehen, ist AP {} µm",
    "RP is of {} readings a pose and more": "RP ist aus {} und mehr Ablesungen je Pose",
    "ISO 9283 asks for thirty": "ISO 9283 verlangt dreißig",
    "poses that were measured again moved by {} µm from the first row to the last: the robot's base, the arm or the instrument drifts, and the figures hold it": "wieder gemessene Posen haben sich von der ersten Zeile bis zur letzten um {} µm bewegt: Sockel, Arm oder Messgerät driften, und die Kenngrößen enthalten es",
    # Axes of rotation.
    "what comes once per turn moves by {} µm with the square of the speed: unbalance": "was einmal je Umdrehung kommt, wächst um {} µm mit dem Quadrat der Drehzahl: Unwucht",
    "whether a resonance makes it grow faster cannot be told with {} speeds": "ob eine Resonanz es schneller wachsen lässt, sagen {} Drehzahlen nicht",
    "{} of {} turns have gaps, and are left out": "{} von {} Umdrehungen haben Lücken und sind weggelassen",
    "{} whole turn{}: what differs from turn to turn is hardly known, and with it every uncertainty": "{0} ganze Umdrehung(en): was von Umdrehung zu Umdrehung verschieden ist, ist kaum bekannt, und damit jede Unsicherheit",
    "measure 20 or more": "20 oder mehr messen",
    "the speed changed by {} % during the run: figures are those of no one speed": "die Drehzahl änderte sich im Lauf um {} %: die Kenngrößen gelten für keine bestimmte",
    "measure each speed in a run of its own": "jede Drehzahl in einem eigenen Lauf messen",
}
_WORDS = {
    "cycle to cycle": "Zyklus zu Zyklus",
    "mean": "mittlere",
    "median": "mediane",
    "frame": "Koordinatensystem",
    "frame and tool": "Koordinatensystem und Werkzeug",
}
_PIECES = [(clause.split("{}"), german) for clause, german in CLAUSES.items()]
# A longer text is no finding of dtwin's. Names that stand for ``{}`` have no more blanks than these.
_LONGEST, _MOST_SPACES = 1500, 2
_WORD = re.compile("[A-Za-z]{3}")


def german_of(text: str, tell: Callable[[object], str]) -> str | None:
    """Return a finding or note in German; None when a clause of it is not known. ``tell``: writes names and numbers."""

    # Names of files and machines stand in a finding: each part is looked at once, however they are written.
    @cache
    def clause(part: str) -> str | None:
        for pieces, german in _PIECES:
            if (between := _between(pieces, part)) is not None:
                words = [_WORDS.get(word) or clause(word) or _name(word, tell) for word in between]
                if None not in words:
                    return german.format(*words)
        named, colon, rest = part.partition(": ")
        said = clause(rest) if colon and named.count(" ") <= _MOST_SPACES else None
        return None if said is None else f"{tell(named)}: {said}"

    if len(text) > _LONGEST:
        return None
    parts = re.split(r"(; |\. (?=[A-Z]))", text.removesuffix("."))
    told = [clause(part) if n % 2 == 0 else part for n, part in enumerate(parts)]
    return None if None in told else "".join(map(str, told)) + "." * text.endswith(".")


def _between(pieces: Sequence[str], text: str) -> list[str] | None:
    """Return what stands between the pieces of a clause, each piece at its first place; None for another text."""
    first, *middle = pieces
    if not middle:
        return [] if text == first else None
    *middle, last = middle
    at, end, found = len(first), len(text) - len(last), []
    if at > end or not text.startswith(first) or not text.endswith(last):
        return None
    for piece in middle:
        after = text.find(piece, at, end)
        if after < 0:
            return None
        found.append(text[at:after])
        at = after + len(piece)
    return [*found, text[at:end]]


def _name(text: str, tell: Callable[[object], str]) -> str | None:
    return tell(text) if text.count(" ") <= _MOST_SPACES or not _WORD.search(text) else None
