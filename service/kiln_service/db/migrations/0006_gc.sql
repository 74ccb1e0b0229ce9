-- When what an archived job had besides its package was deleted.

ALTER TABLE jobs ADD COLUMN freed timestamptz;
