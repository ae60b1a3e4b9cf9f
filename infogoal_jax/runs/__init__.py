"""The files of runs: each kind is written, read and checked against its declaration in one module.

RUN/config.json              the resolved configuration, seeds, dataset and versions     configuration.py
RUN/checkpoint               everything that training carries, for all seeds             checkpoint.py
RUN/policy                   parameters alone, of the same epoch                         checkpoint.py
RUN/epochs.csv, .jsonl       a line for each seed and epoch                              tables.py
RUN/evaluations.csv, .jsonl  a line for each seed and evaluation                         tables.py
RUN/timing.json              seconds compiling and running, and rates, of a session      tables.py
RUN/evaluation.json          what `infogoal evaluate` found last                         tables.py
SEARCH/trials.jsonl          values and scores of each trial of a search or a final      search.py
SEARCH/best.json             the best trial, with the flags to give to `infogoal train`  search.py

folder.py gives a run its folder and one writer at a time, and packs a seed of it into one file;
disk.py writes files that survive a crash at any moment, and turns what a file holds into the record that it should be,
or says what is wrong with it.
"""
