"""The pings that a simulator makes of the requests of a batch."""

import xarray as xr

import sonar_gl as sg

N_SMALL = 10


def pings_of(folder, requests, label_level_db=None, with_noise=True):
    """Return the pings that a simulator makes of the requests of a batch in `folder`, by sonar."""
    out = {}
    for name, sonar in requests.sonars.items():
        group = xr.open_dataset(folder / "out" / "pings.zarr", group=name)
        samplings = zip(group.columns_per_beam.values.tolist(), group.rows.values.tolist(), strict=True)
        samplings, pings = [sg.Sampling(*one) for one in samplings], {}
        for sampling in set(samplings):
            with sg.Simulator(requests.scenes[0], sonar, requests.acoustics, sampling) as simulator:
                for request in requests:
                    if samplings[request.number] == sampling:
                        pings[request.number] = simulator.ping(
                            request.vehicle_pose @ requests.mounts[name],
                            request.noise if with_noise else None,
                            requests.noise_seed(name),
                            labels=True,
                            ping_number=request.number,
                            bodies=request.bodies,
                            time_s=request.time_s,
                            reflectivity=request.reflectivity,
                            water=request.water,
                            background=["floor", "wall"],
                            label_level_db=label_level_db,
                        )
        out[name] = [pings[number] for number in range(len(requests))]
    return out
