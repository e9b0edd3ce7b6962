-- A model with adopted effects is of the kind `adopted`: `kind` holds that of the model beneath, `adoption`
-- JSON: {base: {version, kind, sha256}, effects: [{effect, family, channel}]}, NULL without effects.
ALTER TABLE models ADD COLUMN adoption TEXT;

-- Only their weight files tell which effects these rows have; they are asked when the directory is opened.
UPDATE models SET adoption = 'unread' WHERE origin IN ('import', 'diagnosis');
