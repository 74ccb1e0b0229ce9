-- Figures in JSON as SQL reads them: whatever a worker of an earlier version has told, no view and no metric fails on it.

-- A JSON number as a float between -most and most, to 12 digits after the point; NULL where it is no number.
CREATE FUNCTION figure(value jsonb, most numeric) RETURNS double precision LANGUAGE sql IMMUTABLE AS $$
    SELECT CASE WHEN jsonb_typeof(value) = 'number'
        THEN round(LEAST(GREATEST(value::numeric, -most), most), 12)::double precision
    END
$$;

DELETE FROM losses WHERE NOT (step BETWEEN 0 AND 1e15 AND loss BETWEEN -3.4e38 AND 3.4e38);
