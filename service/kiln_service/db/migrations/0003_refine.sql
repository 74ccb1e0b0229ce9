-- The stage between fit and package that makes lobes coherent.

ALTER TABLE tasks
    DROP CONSTRAINT tasks_kind_check,
    ADD CONSTRAINT tasks_kind_check CHECK (kind IN ('prepare', 'render', 'fit', 'refine', 'package'));
