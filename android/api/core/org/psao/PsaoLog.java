package org.psao;

/** Takes a client's messages. */
public interface PsaoLog {
    /** Something failed, and the message says what to do. */
    int ERROR = 1;
    /** Something is not as it should be, and goes on. */
    int WARNING = 2;
    /** What happens, now and then. */
    int INFO = 3;

    /**
     * Takes a message. Called on the thread of the function that has something to say, and only
     * from the constructor of {@link PsaoClient} and from {@link PsaoClient#restart}; a thread of
     * native code's own is attached to the virtual machine until it ends. It must not use the
     * client. What it throws is dropped.
     *
     * @param level {@link #ERROR}, {@link #WARNING} or {@link #INFO}
     * @param message a sentence
     */
    void log(int level, String message);
}
