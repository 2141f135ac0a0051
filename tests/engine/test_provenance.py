"""The meta of pings that several threads make at once."""

import json
from dataclasses import replace

import sonar_gl as sg
from sonar_gl.engine.provenance import Provenance, SampleOrigin

ACOUSTICS = sg.Acoustics.ideal()
FIRST = SampleOrigin("first", ("ball",), (), 0.01, "none", "cpu")


def test_a_ping_that_another_thread_makes_meanwhile_does_not_change_the_meta():
    """Bodies may be added, and a ping of the new scene made, while one of the old scene is finished."""
    provenance = Provenance(sg.load_sonar("p900-45"), ACOUSTICS)
    of_other = []

    class MetMeanwhile(SampleOrigin):
        """An origin during whose comparison another ping is made."""

        def __ne__(self, other):
            of_other.append(provenance.meta(replace(FIRST, bodies=("ball", "box")), ACOUSTICS)["bodies"])
            return False

    provenance.meta(FIRST, ACOUSTICS)
    assert provenance.meta(MetMeanwhile(**vars(FIRST)), ACOUSTICS)["bodies"] == ["ball"]
    assert of_other == [["ball", "box"]]


def test_pings_own_their_meta():
    provenance = Provenance(sg.load_sonar("p900-45"), ACOUSTICS)
    first, second = (provenance.meta(FIRST, ACOUSTICS, seed=seed) for seed in (1, 2))
    first["bodies"].append("mine")
    assert second["bodies"] == ["ball"] and (first["seed"], second["seed"]) == (1, 2)


def test_meta_reads_back_from_json_as_it_is():
    """The azimuths of a table of beams were a tuple in a ping, and a list in the ping that its file held."""
    sonar = replace(sg.load_sonar("p900-45"), n_beams=3, beam_azimuths_deg=(-10.0, 0.0, 5.0))
    meta = Provenance(sonar, ACOUSTICS).meta(FIRST, ACOUSTICS)
    assert json.loads(json.dumps(meta)) == meta
    assert sg.Sonar(**meta["sonar"]) == sonar
