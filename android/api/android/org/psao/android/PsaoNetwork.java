package org.psao.android;

import android.content.Context;
import android.net.ConnectivityManager;
import android.net.Network;

/**
 * Says when the device's network becomes another one. A connection of the old one would only find
 * out by waiting: close it, open a new one, call {@link org.psao.PsaoClient#restart}, and push. AO
 * stays as it was meanwhile.
 *
 * <p>Needs the permission {@code ACCESS_NETWORK_STATE}, which this library's manifest asks for.
 */
public final class PsaoNetwork extends ConnectivityManager.NetworkCallback
        implements AutoCloseable {
    private final ConnectivityManager manager;
    private final Runnable changed;
    private Network network;

    /**
     * Begins to watch. The network that is there now is no change.
     *
     * @param context any
     * @param changed is run when there is a network again, or another one; on a thread of the
     *     system's, so it must not wait
     */
    public PsaoNetwork(Context context, Runnable changed) {
        this.changed = changed;
        manager = context.getSystemService(ConnectivityManager.class);
        manager.registerDefaultNetworkCallback(this);
    }

    @Override
    public synchronized void onAvailable(Network available) {
        boolean another = network != null && !network.equals(available);
        network = available;
        if (another) {
            changed.run();
        }
    }

    /** Ends watching. Call it once. */
    @Override
    public void close() {
        manager.unregisterNetworkCallback(this);
    }
}
