package org.psao;

/**
 * A native function failed. The message begins with the result's name as in {@code psao.h}, and
 * says what to do; of a failed stream it also says what was wrong.
 */
public final class PsaoException extends RuntimeException {
    private static final long serialVersionUID = 1;

    private final int result;

    PsaoException(int result, String text) {
        super(text.isEmpty()
                ? Native.resultText(result) : Native.resultText(result) + " (" + text + ")");
        this.result = result;
    }

    /**
     * Which failure it is.
     *
     * @return one of the constants of {@link PsaoResult}, or of a newer library; below 0
     */
    public int result() {
        return result;
    }

    /** Throws if it is a failure. */
    static int check(int result) {
        if (result < 0) {
            throw new PsaoException(result, "");
        }
        return result;
    }
}
