"""Data sets of many pings, from a job file. The flow is job -> manifest -> parts -> data set.

`job` reads and checks the tables of the TOML file. What they name is loaded by `job_settings` (sonars, acoustics,
noise) and `job_scenes`. `requests` has the runs: which pings go along which of the `trajectories`, in which scene. It
computes the request of any ping from its number alone: scene, time, pose along a trajectory, random `variation` by
`random_streams`. `job_warnings` has the warnings that are given before any ping. `schema` decides which arrays and
attributes are stored. `steps` has the steps: begin the batch, which the `manifest` records; create the Zarr
`store`; make one of its `parts`, whose pings go to the `outputs` (store, pictures, `coco`, `optical`, bags of
`sonar_gl.ros`) and into its `ping_table`; finalize, which joins the files of all parts. `run` begins or resumes a batch
and does all of it; `dry_run` tells what it would be, by a `survey` of some pings. The steps run in the processes of a
`pool`, or on the workers of a `cluster`. All files are in one `folder`. The job alone decides their bytes: any process
can make any part, in any order, and make it again.
"""
