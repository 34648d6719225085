package org.psao;

/**
 * What native functions answer, by the names of {@code psao_result} in {@code psao.h}: 0 or more is
 * a success, less is a failure, which comes as a {@link PsaoException}. New ones may come.
 */
public final class PsaoResult {
    /** Done. From {@link PsaoClient#push}: a frame was completed, take it before you push on. */
    public static final int OK = 0;

    /** All input was used, and more is needed. Nothing to do but to go on. */
    public static final int NEED_MORE = 1;

    /** Nothing came since the last take. Keep what you have. */
    public static final int NOTHING_NEW = 2;

    /**
     * The mirror differs from the server's. Send {@link PsaoUplink#resync}, and push on: the
     * last frame stays in place until a snapshot comes.
     */
    public static final int RESYNC = 3;

    /** A pointer is NULL that must not be. */
    public static final int ERROR_NULL = -1;

    /**
     * struct_size is not that of a struct this library knows, or the part it does not know
     * is not zero: use the library that the header came with, or a newer one.
     */
    public static final int ERROR_STRUCT = -2;

    /** A value is out of its range: see the function. */
    public static final int ERROR_VALUE = -3;

    /** Called at a time when it makes no sense: see the function. */
    public static final int ERROR_ORDER = -4;

    /** The memory is smaller than {@link PsaoConfig#memoryBytes} says. */
    public static final int ERROR_MEMORY_SIZE = -5;

    /** The memory is not aligned as {@link PsaoConfig#memoryBytes} says. */
    public static final int ERROR_MEMORY_ALIGN = -6;

    /** An earlier push failed: connect anew and call {@link PsaoClient#restart}. */
    public static final int ERROR_FAILED = -7;

    /** These bytes are not a PSAO stream: look at where they come from. */
    public static final int ERROR_NOT_A_STREAM = -20;

    /** Another version or profile of the format: use matching versions of server and library. */
    public static final int ERROR_VERSION = -21;

    /**
     * Bytes were lost or changed on the way: connect anew. If it persists, the transport
     * does not deliver everything in order.
     */
    public static final int ERROR_DAMAGED = -22;

    /** The bytes break the format: a faulty or hostile server. Connect anew. */
    public static final int ERROR_FORMAT = -23;

    /** The server has another scene: load the same files on both sides. */
    public static final int ERROR_SCENE = -24;

    /**
     * The server refused for a reason that this library does not know: the exception's
     * message has the server's words.
     */
    public static final int ERROR_REFUSED = -30;

    /** The server wants another token: pass the one it was started with. */
    public static final int ERROR_REFUSED_TOKEN = -31;

    /** The server has another scene: load the same files on both sides. */
    public static final int ERROR_REFUSED_SCENE = -32;

    /** The server speaks another version: update the older side. */
    public static final int ERROR_REFUSED_VERSION = -33;

    /** The scene needs more room than the hello offered: raise the counts in {@link PsaoConfig}. */
    public static final int ERROR_REFUSED_CAPACITY = -34;

    /** The server serves as many clients as it may: try again later. */
    public static final int ERROR_REFUSED_FULL = -35;

    /** The server did not understand the first message: it must be {@link PsaoUplink#hello}'s. */
    public static final int ERROR_REFUSED_MALFORMED = -36;

    /**
     * The stream needs more than {@link PsaoConfig} allows: psao_client_error_text says
     * what, and {@link PsaoConfig#fromStream} fills a config that is enough.
     */
    public static final int ERROR_CAPACITY = -40;

    /** The buffer for what the function writes is too small. */
    public static final int ERROR_OUTPUT_SIZE = -41;

    /**
     * No server answers at the address, or the system has no socket or thread to give:
     * {@link PsaoConnection}'s text says which.
     */
    public static final int ERROR_NO_CONNECTION = -50;

    /**
     * Who answers has not the certificate that was asked for: take the fingerprint that the
     * server prints, or the roots that signed its certificate.
     */
    public static final int ERROR_UNTRUSTED = -51;

    /** The connection is closed: open a new one, and call {@link PsaoClient#restart}. */
    public static final int ERROR_CLOSED = -52;

    /** The network is slower than what is to be sent: send the newest state again later. */
    public static final int ERROR_BUSY = -53;

    /**
     * A defect of the library: it stopped before it could do harm. This client answers
     * nothing else from now on; make a new one, and please report it.
     */
    public static final int ERROR_INTERNAL = -90;

    private PsaoResult() {}
}
