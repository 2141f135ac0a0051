"""The compiled sums: samples into columns and range bins, columns into beams, for echoes, labels and multipath.

| module | what it does | entry functions |
| --- | --- | --- |
| `work_table` | the table in which functions leave what they find of a strip's samples | `make_work` |
| `range_bins` | the edges of range bins, and tables of them | `bin_table` |
| `joined_rows` | lets one sample stand for several rows of one face | |
| `borders` | finds where the footprint of each sample begins | |
| `strips` | finds a strip's samples and borders: the walk that all sums share | |
| `footprints` | finds the energy of footprints, and how far they extend in range | |
| `spreading` | adds footprints to range bins | |
| `body_counts` | counts the samples on each body, to judge how well they show it | `count_samples` |
| `column_sums` | sums samples, or points, into columns and bins | `sum_footprints`, `add_points` |
| `beams` | weighs columns, and adds far side lobes | `weigh_columns`, `add_far_lobes` |
| `moments` | labels: adds footprints of one body to range bins, with moments | |
| `runs` | labels: sorts sums of bodies by body and column | `sort_runs`, `sum_body_echo` |
| `body_sums` | labels: sums samples into columns and bins, for each body | `sum_bodies` |
| `strongest` | labels: finds the strongest body of each bin of each beam | `find_strongest` |
| `views` | finds what a view sees in some directions | `view_index`, `find_surfaces` |
| `image_sources` | sums what a reflector returns | `estimate_reflection`, `expect_imaged`, `sum_image_source` |

Modules import from those above them alone. `sum_footprints` shows how they act together; sums of labels and of image
sources take the same steps.

The machine code of a package named "kernels" is looked up by all of its files (`sonar_gl.core.compiled.sources_of`). So
its functions may call functions, and read constants, of each other's modules, and of no module outside.

Letters of all modules:

| letter | meaning |
| --- | --- |
| i, j | column and row of a sample in the window of its sector |
| u, v | place on the image plane of a sector, whose direction is (1, −u, v) |
| q | 1/x of a surface, which is linear in u and v on a plane |
| s | 1/r of it, r being slant range |
| p, m | strip of a sector, and sample of a strip |
| c, k, K | column of sums, range bin, and number of bins |

Entry functions take plain tuples where inner ones take NamedTuples, and name them on their first line: Numba finds
the type of a plain tuple in 0.1 µs, that of a NamedTuple in 9 µs. Loops over samples pass none on: each call would
count references to all of its arrays, which takes as long as all the rest.

Loops over a strip's samples have no branches, so that the compiler can vectorise them. Indices are unsigned: an index
that may be negative prevents vectorisation.
"""
