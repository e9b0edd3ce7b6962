-- Figures of a model's FRF, so that a list of models needs no weight files.

ALTER TABLE models ADD COLUMN frf TEXT; -- JSON: usable band, averages, coherence; NULL: no FRF, or stored before
